"""What detectors see of a flight."""

from itertools import pairwise

import numpy as np
import pytest

from deploy.bench.detector_series import series
from deploy.mission.flight import FlownMission, fly
from deploy.mission.fork_server import ForkServer
from detector.schemes.gaussian import Gaussian
from detector.schemes.registry import load_detector, with_models
from detector.series.monitored_states import WATCHED
from services.bus.arrays import plan
from services.bus.messages import decode
from services.bus.topics import TOPICS
from services.models.mission import MissionSpec

SPEC = MissionSpec(world="dense", seed=4)


@pytest.fixture(scope="module")
def flight(server: ForkServer) -> FlownMission:
    return fly(SPEC, server, keep_messages=True)


def test_every_message_is_a_check_and_every_waypoint_a_planned_row_or_a_stop(flight: FlownMission) -> None:
    seen = series(SPEC, flight)
    assert flight.messages is not None
    for stage, topic in (
        ("perception", "collision_check"),
        ("planning", "trajectory"),
        ("control", "command"),
    ):
        assert len(seen.checks[stage]) == len(flight.messages[topic])
        assert seen.checks[stage].values.shape[1] == len(WATCHED[stage])
    made = [plan(decode(m.payload, TOPICS["trajectory"].type)).points for m in flight.messages["trajectory"]]
    follows = {(a[1:10].tobytes(), b[1:10].tobytes()): b[0] - a[0] for p in made for a, b in pairwise(p)}
    control = seen.checks["control"]
    planned = 0
    for index in range(len(control)):
        behind, ahead = control.values[control.rows(index)]
        pair = behind[2:11].tobytes(), ahead[2:11].tobytes()
        if pair in follows:
            planned += 1
            assert ahead[1] == follows[pair]
        else:
            assert not ahead[5:8].any(), "neither planned nor a stop"
    assert planned > 0.8 * len(control)


def test_the_shipped_detectors_let_a_golden_flight_pass(flight: FlownMission) -> None:
    seen = series(SPEC, flight)
    for name in with_models():
        detector = load_detector(name)
        for stage, checks in seen.checks.items():
            for index in range(len(checks)):
                assert detector.check(stage, checks.values[checks.rows(index)]) is None, (name, stage, index)


def test_a_flight_teaches_the_same_twice(flight: FlownMission, server: ForkServer) -> None:
    again = fly(SPEC, server, keep_messages=True)
    first, second = (Gaussian.lesson(series(SPEC, one)) for one in (flight, again))
    assert all(np.array_equal(first[name], second[name]) for name in first)
