"""Flights are judged by their true path, and harm is what the golden twin does not have."""

import pytest

from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from services.models.faults.specification import FaultSpec
from services.models.mission import Limits, MissionSpec
from services.models.oracles.properties import SIGNALS

SHORT = Limits(mission_time_s=6.0)
JUDGED = ("always clearance >= 0.3", "always deviation <= 0.01", "always flight_time <= 5")


@pytest.fixture(scope="module")
def pairs(server: ForkServer) -> PairFlyer:
    return PairFlyer(server)


def test_a_golden_flight_is_judged_and_flies_the_same(pairs: PairFlyer) -> None:
    plain = pairs.fly(MissionSpec(seed=7, limits=SHORT))
    wanted = tuple(f"always {signal} >= -1" for signal in SIGNALS)
    judged = pairs.fly(MissionSpec(seed=7, limits=SHORT, properties=(*JUDGED, *wanted)))
    assert (judged.digest, judged.harm) == (plain.digest, None)
    near, strayed, late, *all_ = judged.properties
    assert near.robustness == judged.qof.min_clearance_m - 0.3
    assert (strayed.robustness, strayed.holds) == (0.01, True)
    assert (late.robustness, late.holds, late.at_ns) == (-1.0, False, 5_004_000_000)
    assert all(one.holds for one in all_)
    assert plain.properties == []


def test_only_what_the_twin_kept_is_harm(pairs: PairFlyer) -> None:
    """The flight leaves its twin's path; that both are longer than 5 s and end by timeout is no harm."""
    fault = FaultSpec(level="sensor", target="odometry", model="wrong", size=1.5, from_s=3.0)
    outcome = pairs.fly(MissionSpec(seed=7, limits=SHORT, properties=JUDGED, fault=fault))
    assert outcome.golden is not None
    assert outcome.digest != outcome.golden.digest
    assert outcome.harm is not None
    assert [(one.kind, one.property) for one in outcome.harm] == [("property_violated", JUDGED[1])]
    assert 3_000_000_000 < outcome.harm[0].at_ns < 6_000_000_000
