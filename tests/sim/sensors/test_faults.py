"""A sensor that fails says something else, or nothing, between two times, and the record says what."""

from typing import Any

import numpy as np
import pytest

from services.bus.arrays import state
from services.bus.messages import header
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec
from sim.flight import SimulatedFlight
from sim.sensors import telemetry
from sim.sensors.camera import DepthCamera
from sim.sensors.faults import SensorFault

TICK_NS = 40_000_000
KINDS: tuple[dict[str, object], ...] = (
    {"model": "off"},
    {"model": "stuck"},
    {"model": "garbage"},
    {"model": "wrong", "size": 0.5},
    {"model": "slow", "size": 0.2},
    {"model": "delayed", "size": 0.2},
    {"model": "intermittent", "probability": 0.5},
)


def failing(target: str, **fields: object) -> SensorFault:
    spec = FaultSpec.model_validate(
        {"level": "sensor", "target": target, "from_s": 0.4, "until_s": 1.2, **fields}
    )
    return SensorFault(spec, mission_seed=1)


@pytest.fixture(scope="module")
def measured() -> dict[str, list[Any]]:
    """Two seconds of each sensor, of a vehicle that flies."""
    spec = MissionSpec(seed=7)
    flight = SimulatedFlight(spec)
    camera = DepthCamera(spec.camera, spec.seed)
    found: dict[str, list[Any]] = {"odometry": [], "imu": [], "depth": []}
    for tick in range(50):
        flight.advance(tick * TICK_NS, [(tick * TICK_NS, np.array([2.0, 0.0, 0.0, 0.0]))])
        stamp = header(tick * TICK_NS, "map")
        found["odometry"].append(telemetry.odometry(stamp, flight.vehicle, flight.drift))
        assert flight.felt is not None
        found["imu"].append(telemetry.imu(stamp, flight.felt))
        found["depth"].append(telemetry.depth_image(stamp, camera, flight.vehicle))
    return found


def published(sensor: SensorFault, messages: list[Any]) -> tuple[list[Any], list[Any]]:
    """What was published in place of each, and the records."""
    found = [sensor.publish(message, number * TICK_NS) for number, message in enumerate(messages)]
    return [one.message for one in found], [one.record for one in found if one.record is not None]


@pytest.mark.parametrize("target", ["odometry", "imu", "depth"])
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: str(kind["model"]))
def test_it_fails_between_two_times_and_repeats(
    target: str, kind: dict[str, object], measured: dict[str, list[Any]]
) -> None:
    messages = measured[target]
    out, records = published(failing(target, **kind), messages)
    assert out[:10] == messages[:10]
    assert out[30:] == messages[30:]
    assert records
    for record in records:
        assert 10 <= record.invocation < 30
        assert record.virtual_time_ns == record.invocation * TICK_NS
        assert record.before != record.after == record.read_back
    again, same = published(failing(target, **kind), messages)
    assert [one.after for one in same] == [one.after for one in records]
    assert [one is None for one in again] == [one is None for one in out]


def test_what_is_off_is_not_published(measured: dict[str, list[Any]]) -> None:
    out, records = published(failing("odometry", model="off"), measured["odometry"])
    assert out[10:30] == [None] * 20
    assert {record.after for record in records} == {"nothing"}


def test_what_is_stuck_says_the_same_with_new_stamps(measured: dict[str, list[Any]]) -> None:
    out, _ = published(failing("odometry", model="stuck"), measured["odometry"])
    assert all((state(one).position == state(out[9]).position).all() for one in out[10:30])
    assert [one.header.stamp for one in out] == [one.header.stamp for one in measured["odometry"]]


def test_what_is_delayed_was_true_a_while_ago(measured: dict[str, list[Any]]) -> None:
    out, _ = published(failing("odometry", model="delayed", size=0.2), measured["odometry"])
    assert out[10:30] == measured["odometry"][5:25]


def test_what_is_slow_comes_now_and_then(measured: dict[str, list[Any]]) -> None:
    out, _ = published(failing("odometry", model="slow", size=0.2), measured["odometry"])
    assert [number for number in range(10, 30) if out[number] is not None] == [14, 19, 24, 29]


def test_what_is_wrong_is_off_by_its_size(measured: dict[str, list[Any]]) -> None:
    out, _ = published(failing("odometry", model="wrong", size=3.0), measured["odometry"])
    true, said = state(measured["odometry"][15]), state(out[15])
    assert said.position - true.position == pytest.approx([3.0, 0.0, 0.0])
    assert said.velocity == pytest.approx(true.velocity)
    near, _ = published(failing("depth", model="wrong", size=0.5), measured["depth"])
    was, now = (one[15].data.view(np.float32) for one in (measured["depth"], near))
    seen = np.isfinite(was)
    assert now[seen] == pytest.approx(0.5 * was[seen])


def test_the_message_that_was_measured_stays_as_it_is(measured: dict[str, list[Any]]) -> None:
    before = measured["odometry"][15].pose.pose.position.x
    published(failing("odometry", model="wrong", size=3.0), measured["odometry"])
    assert measured["odometry"][15].pose.pose.position.x == before
