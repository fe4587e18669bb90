"""A motor that fails gives another thrust than it is asked for, and the vehicle feels it."""

import numpy as np
import pytest

from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec
from sim.flight import SimulatedFlight
from sim.vehicle.airframe import airframe
from sim.vehicle.motor_fault import MotorFault
from sim.vehicle.vehicle import STEP_S

MOST_N = airframe("airsim").max_thrust_n
STEPS = 500
FROM, UNTIL = 125, 250


def fault(**fields: object) -> FaultSpec:
    window = {"from_s": FROM * STEP_S, "until_s": UNTIL * STEP_S}
    return FaultSpec.model_validate({"level": "actuator", "target": "motor2", **window, **fields})


def given(**fields: object) -> tuple[np.ndarray, MotorFault]:
    """The thrust of the motor in each period, asked for a ramp."""
    motor = MotorFault(fault(**fields), 1, MOST_N, STEP_S)
    thrusts = np.empty(STEPS)
    for step in range(STEPS):
        thrust = np.full(4, 1.0 + step / STEPS)
        motor.strike(step, thrust)
        assert (thrust[[0, 1, 3]] == 1.0 + step / STEPS).all()
        thrusts[step] = thrust[2]
    return thrusts, motor


ASKED = 1.0 + np.arange(STEPS) / STEPS


@pytest.mark.parametrize(
    "fields",
    [
        {"model": "off"},
        {"model": "stuck"},
        {"model": "garbage"},
        {"model": "wrong", "size": 0.5},
        {"model": "wrong", "size": 100.0},
        {"model": "wrong", "size": -1.0},
        {"model": "slow", "size": 0.1},
        {"model": "delayed", "size": 0.1},
        {"model": "intermittent", "probability": 0.5},
    ],
    ids=lambda fields: f"{fields['model']} {fields.get('size', '')}",
)
def test_it_fails_between_two_times_within_what_it_can_do_and_repeats(fields: dict[str, object]) -> None:
    thrusts, motor = given(**fields)
    outside = [step for step in range(STEPS) if not FROM <= step < UNTIL]
    assert (thrusts[outside] == ASKED[outside]).all()
    assert (thrusts[FROM:UNTIL] != ASKED[FROM:UNTIL]).any()
    assert (thrusts >= 0.0).all()
    assert (thrusts <= MOST_N).all()
    assert [record.invocation for record in motor.records] == list(np.flatnonzero(thrusts != ASKED))
    assert all(record.after == record.read_back != record.before for record in motor.records)
    assert (given(**fields)[0] == thrusts).all()


def test_each_way_to_fail_does_what_it_says() -> None:
    inside = slice(FROM, UNTIL)
    assert (given(model="off")[0][inside] == 0.0).all()
    assert (given(model="stuck")[0][inside] == ASKED[FROM - 1]).all()
    assert given(model="wrong", size=0.5)[0][inside] == pytest.approx(0.5 * ASKED[inside])
    assert given(model="delayed", size=0.1)[0][inside] == pytest.approx(ASKED[FROM - 25 : UNTIL - 25])
    assert len(set(given(model="slow", size=0.1)[0][inside])) == 6
    assert set(given(model="intermittent", probability=0.5)[0][inside] == 0.0) == {True, False}


def test_a_vehicle_that_loses_a_motor_comes_down() -> None:
    lost = FaultSpec.model_validate({"level": "actuator", "target": "motor0", "model": "off", "from_s": 1.0})
    heights = {}
    for name, spec in (("whole", MissionSpec(seed=1)), ("lost", MissionSpec(seed=1, fault=lost))):
        flight = SimulatedFlight(spec)
        for tick in range(50):
            flight.advance(tick * 40_000_000, [])
        heights[name] = flight.vehicle.position[2]
    assert heights["lost"] < heights["whole"] - 0.5
