"""A flight stands for those with fewer guards if none that they leave out has acted, and for no others."""

import pytest

from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from services.models.faults.specification import FaultSpec, Trigger
from services.models.mission import MissionSpec
from services.models.outcome import Proof
from services.models.pilots import GuardName
from tests.bench.proofs import comparable

BASE: tuple[GuardName, ...] = ("clip", "restart")
REFUSALS: tuple[GuardName, ...] = (*BASE, "range", "order", "strayed")
NO_NUMBER = FaultSpec(
    level="source",
    target="collision_check.time_to_collision",
    bit_numbers=(0,),
    trigger=Trigger(invocation=3),
)
"""Infinity with one more bit: nothing for ``finite`` to let pass, and everything for the others."""


def mission(guards: tuple[GuardName, ...], fault: FaultSpec | None = NO_NUMBER) -> MissionSpec:
    pace = {"take_off_s": 1.0, "look_round_s": 2.0, "plan_wait_s": 1.0}
    given = {"seed": 1, "pilot": "baseline", "pace": pace, "limits": {"mission_time_s": 8.0}}
    return MissionSpec.model_validate({**given, "guards": guards, "fault": fault})


@pytest.fixture(scope="module")
def pairs(server: ForkServer) -> PairFlyer:
    """With the flights of all that refuses but ``finite``, and of that with it."""
    pairs = PairFlyer(server)
    assert pairs.fly(mission(REFUSALS), ahead=()).proof is None
    outcome = pairs.fly(mission((*REFUSALS, "finite")), ahead=())
    assert outcome.proof is None
    assert sum(report.guards.get("finite", 0) for report in outcome.nodes.values()) > 0
    return pairs


@pytest.mark.parametrize("guards", [BASE, (*BASE, "finite", "range")])
def test_fewer_guards_that_had_not_acted_are_the_same_flight(
    pairs: PairFlyer, server: ForkServer, guards: tuple[GuardName, ...]
) -> None:
    proven = pairs.fly(mission(guards), ahead=())
    assert proven.proof == Proof(by="idle_guards")
    assert comparable(proven) == comparable(PairFlyer(server).fly(mission(guards)))


def test_a_flight_in_which_a_guard_acted_does_not_stand_for_those_without_it(server: ForkServer) -> None:
    pairs = PairFlyer(server)
    pairs.fly(mission((*BASE, "finite", "order")), ahead=())
    assert pairs.idle_guards.known(mission((*BASE, "order"))) is None
    assert pairs.idle_guards.known(mission((*BASE, "finite"))) is not None


def test_a_guard_that_no_flight_had_is_flown(pairs: PairFlyer) -> None:
    assert pairs.idle_guards.known(mission((*BASE, "brake"))) is None


def test_of_dense_every_flight_is_another(server: ForkServer) -> None:
    pairs = PairFlyer(server)
    pairs.fly(mission((*BASE, "dense")), ahead=())
    assert pairs.idle_guards.known(mission(BASE)) is None
    assert pairs.idle_guards.known(mission((*BASE, "dense"))) is not None


def test_faults_in_instructions_are_not_shared(server: ForkServer) -> None:
    pairs = PairFlyer(server)
    fault = FaultSpec(target="pid", trigger=Trigger(invocation=30))
    pairs.fly(mission(REFUSALS, fault), ahead=())
    assert pairs.idle_guards.known(mission(BASE, fault)) is None


def test_recordings_and_flights_in_full_are_flown(pairs: PairFlyer) -> None:
    assert pairs.fly(mission(BASE)).proof is None
