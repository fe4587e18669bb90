"""A flight beside its golden twin."""

import pytest

from deploy.errors import DisturbedFlightError
from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer, draw_call, require_drawn_instruction
from services.kernels import KERNELS
from services.models.faults.specification import FaultSpec, Site, Trigger
from services.models.mission import Limits, MissionSpec
from services.models.outcome import InjectionRecord

SHORT = Limits(mission_time_s=6.0)
"""Every kernel is called in this time."""


EXACT = Trigger(site=Site(precision="exact", module="numba", build_id="ab", offset=523, hit=40))
ENDED = "the call ended after 1 of 40 passes"


def missed(status: str, trigger: Trigger = EXACT) -> InjectionRecord:
    where = {"node": "perception", "kernel": "pid", "invocation": 3}
    told = {"status": status, "reason": ENDED, "trigger": trigger}
    return InjectionRecord.model_validate({**where, **told})


@pytest.mark.parametrize("status", ["not_reached", "diverged"])
def test_a_call_that_ended_without_what_its_copy_executed_is_no_result(status: str) -> None:
    spec = MissionSpec(fault=FaultSpec(target="pid", trigger=Trigger(invocation=3)))
    with pytest.raises(DisturbedFlightError, match=ENDED):
        require_drawn_instruction(spec, missed(status))


@pytest.mark.parametrize("trigger", [EXACT, Trigger(invocation=3)])
def test_where_no_instruction_was_drawn_none_is_missed(trigger: Trigger) -> None:
    named = MissionSpec(fault=FaultSpec(target="pid", trigger=trigger))
    require_drawn_instruction(
        named, missed("not_reached", Trigger(cpu_ns=5) if trigger is not EXACT else EXACT)
    )
    require_drawn_instruction(named, missed("injected"))


@pytest.fixture(scope="module")
def pairs(server: ForkServer) -> PairFlyer:
    return PairFlyer(server)


@pytest.mark.parametrize(
    "target", ["point_cloud", "octomap", "collision_check", "rrt_star", "trajectory", "pid"]
)
def test_all_of_an_injection_but_the_flip_is_benign(pairs: PairFlyer, target: str) -> None:
    fault = FaultSpec(target=target, model="none", seed=4)
    outcome = pairs.fly(MissionSpec(seed=7, fault=fault, limits=SHORT))
    assert outcome.golden is not None
    assert outcome.injection is not None
    assert outcome.injection.status == "not_activated"
    assert outcome.injection.model == "none"
    assert outcome.injection.before == outcome.injection.after == outcome.injection.read_back
    assert outcome.nodes[KERNELS[target].stage].result == "benign"
    assert (outcome.digest, outcome.qof) == (outcome.golden.digest, outcome.golden.qof)


def test_a_call_that_ends_after_the_flight_is_not_drawn_but_struck_if_asked_for(pairs: PairFlyer) -> None:
    """In this flight the second call of the planner begins just before the end."""
    spec = MissionSpec(seed=5002, limits=Limits(mission_time_s=8.0))
    for asked, trigger in ((0, None), (1, Trigger(invocation=1))):
        fault = FaultSpec(target="rrt_star", model="none", seed=1, trigger=trigger)
        outcome = pairs.fly(spec.model_copy(update={"fault": fault}))
        assert outcome.nodes["planning"].kernels["rrt_star"].invocations == 1
        assert outcome.injection is not None
        assert (outcome.injection.status, outcome.injection.invocation) == ("not_activated", asked)


def test_faults_may_share_calls(pairs: PairFlyer) -> None:
    golden = pairs.fly(MissionSpec(seed=7, limits=SHORT))

    def calls(trigger: Trigger) -> list[int | None]:
        faults = [FaultSpec(target="pid", seed=seed, trigger=trigger) for seed in range(60)]
        return [draw_call(fault, golden).invocation for fault in faults]

    shared = calls(Trigger(calls=3))
    assert shared == shared[:3] * 20
    assert shared[:3] == calls(Trigger())[:3]
    assert len(set(shared)) == 3


def test_the_record_says_which_fault_it_was(pairs: PairFlyer) -> None:
    fault = FaultSpec(target="rrt_star", model="opcode", scope="kernel", seed=1)
    injection = pairs.fly(MissionSpec(seed=7, fault=fault, limits=SHORT)).injection
    assert injection is not None
    assert (injection.model, injection.scope) == ("opcode", "kernel")
    if injection.status == "injected":
        assert injection.instruction_after
        assert injection.module.startswith("libompl") or not injection.module
