"""What the page of a run draws, from real flights."""

import numpy as np
import pytest

from dashboard.web.charts import run_data
from deploy.mission.flight import FlownMission, fly
from deploy.mission.fork_server import ForkServer
from services.models.detection import Action, AlarmRecord, DetectionReport, DetectorSpec
from services.models.faults.specification import FaultSpec, Trigger
from services.models.inter_kernel_states import STATES
from services.models.mission import Limits, MissionSpec

SPEC = MissionSpec(seed=7, limits=Limits(mission_time_s=8))
STRUCK_AT = 120
FAULT = FaultSpec(
    level="source",
    target="command.vx",
    bit_numbers=(62,),
    trigger=Trigger(invocation=STRUCK_AT),
)


@pytest.fixture(scope="module")
def golden(server: ForkServer) -> FlownMission:
    return fly(SPEC, server, keep_messages=True)


@pytest.fixture(scope="module")
def injected(server: ForkServer) -> FlownMission:
    return fly(SPEC.model_copy(update={"fault": FAULT}), server, keep_messages=True)


def test_a_way_is_where_the_vehicle_was_tick_by_tick(golden: FlownMission) -> None:
    assert golden.messages is not None
    way = run_data.way(golden.messages)
    assert len(way.times_s) == len(golden.messages["odometry"])
    assert np.linalg.norm(way.at(0.0) - (-25.0, 5.0, 2.0)) < 0.5
    assert np.array_equal(way.at(way.end_s + 100), way.points[-1])
    flown = np.linalg.norm(np.diff(way.points, axis=0), axis=1).sum()
    assert flown == pytest.approx(golden.outcome.qof.distance_m, abs=0.5)


def test_two_flights_part_only_after_the_strike(golden: FlownMission, injected: FlownMission) -> None:
    assert golden.messages is not None
    assert injected.messages is not None
    times, metres = run_data.apart(run_data.way(injected.messages), run_data.way(golden.messages))
    (strike,) = run_data.moments(injected.outcome)
    assert strike.name == "fault"
    assert not metres[times <= strike.time_s].any()
    assert metres[times > strike.time_s + 0.5].any()


def test_the_struck_state_differs_in_the_struck_message_first(
    golden: FlownMission, injected: FlownMission
) -> None:
    assert golden.messages is not None
    assert injected.messages is not None
    assert run_data.first_choice(injected.outcome) == "command.vx"
    twins, faulty = run_data.curves(injected.messages, golden.messages, "command.vx")
    assert (twins.name, faulty.name) == ("golden", "injected")
    shorter = min(len(twins.values), len(faulty.values))
    differs = np.flatnonzero(twins.values[:shorter] != faulty.values[:shorter])
    assert differs[0] == STRUCK_AT


def test_every_state_has_values_and_an_axis(golden: FlownMission) -> None:
    assert golden.messages is not None
    for name, state in STATES.items():
        times, values = run_data.values(golden.messages, name)
        assert len(times) == len(values) == len(golden.messages[state.topic])
        assert run_data.quantity(name).endswith(")")


@pytest.mark.parametrize(
    ("alarms", "name"),
    [
        ([], "with detector"),
        ([("published", True)], "with detector"),
        ([("waypoint_dropped", True)], "with detector"),
        ([("recomputed", False)], "with detector"),
        ([("published", True), ("recomputed", True)], "recomputed"),
        ([("recomputed", True), ("simple", True)], "fallback"),
        ([("recomputed", True), ("simple", False)], "recomputed"),
    ],
)
def test_a_flight_is_called_by_what_was_done_after_the_strike(
    injected: FlownMission,
    alarms: list[tuple[Action, bool]],
    name: str,
) -> None:
    raised = [
        AlarmRecord(
            stage="control",
            topic="command",
            state="",
            row=0,
            score=2,
            virtual_time_ns=1,
            action=did,
            true=true,
        )
        for did, true in alarms
    ]
    report = DetectionReport(alarms=raised, checks=9, detection_share=0, recomputation_share=0, ungated=0)
    watched = injected.outcome.spec.model_copy(update={"detector": DetectorSpec(scheme="gaussian")})
    outcome = injected.outcome.model_copy(update={"spec": watched, "detection": report})
    assert run_data.called(outcome) == name
    assert run_data.called(injected.outcome) == "injected"
