"""Faults that recur in the instructions of a kernel, in flight: they repeat, and what they cost."""

import time

import pytest

from deploy.config.check import check
from deploy.errors import BadSpecError
from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from deploy.pairing.replay import replay
from services.models.faults.specification import FaultSpec
from services.models.mission import Limits, MissionSpec
from services.models.outcome import STRIKES_KEPT, InjectionRecord, Outcome

SHORT = Limits(mission_time_s=6.0)

DEFECT = {"recurrence": "permanent", "opcodes": ["vmulsd"], "from_s": 2.0}


def spec(**fault: object) -> MissionSpec:
    return MissionSpec(seed=7, limits=SHORT, fault=FaultSpec.model_validate({"target": "pid", **fault}))


def struck(outcome: Outcome) -> InjectionRecord:
    record = outcome.injection
    assert record is not None
    assert (record.status, record.node, record.kernel) == ("injected", "control", "pid")
    assert len(record.struck) == min(record.strikes, STRIKES_KEPT)
    assert all(one.after == one.read_back != one.before for one in record.struck)
    times = [one.virtual_time_ns for one in record.struck]
    assert times == sorted(times)
    assert times[0] == record.virtual_time_ns
    assert times[-1] <= outcome.qof.flight_time_s * 1e9
    return record


def test_a_defective_unit_replays_to_the_bit(server: ForkServer) -> None:
    outcome = PairFlyer(server).fly(spec(**DEFECT, until_s=4.0, field="exponent"))
    record = struck(outcome)
    assert record.strikes > 1000
    assert {one.instruction.split()[0] for one in record.struck} == {"vmulsd"}
    assert len({tuple(one.bits) for one in record.struck}) == 1
    assert {one.operand for one in record.struck} == {"destination"}
    assert record.struck[0].virtual_time_ns >= 2e9
    command_s = outcome.topics["command"].diverged_at_s
    assert command_s is not None
    assert command_s >= 2.0
    assert replay(outcome, server).answer == "replayed"


@pytest.mark.parametrize(
    "recurrence",
    [
        {"recurrence": "intermittent", "probability": 0.0005, "bit_numbers": [3], "register_class": "vector"},
        pytest.param(
            {"recurrence": "rate", "rate_hz": 300.0, "bit_numbers": [3], "register_class": "vector"},
            marks=pytest.mark.soak,
        ),
        pytest.param(
            {"recurrence": "intermittent", "probability": 0.0005, "model": "memory"}, marks=pytest.mark.soak
        ),
    ],
    ids=["intermittent", "rate", "memory"],
)
def test_what_recurs_is_counted_and_repeats(recurrence: dict[str, object], server: ForkServer) -> None:
    outcome = PairFlyer(server).fly(spec(**recurrence))
    record = struck(outcome)
    assert record.strikes > 5
    assert len({one.invocation for one in record.struck}) > 3
    assert replay(outcome, server).answer == "replayed"


def test_without_a_flip_the_flight_is_its_twin(server: ForkServer) -> None:
    outcome = PairFlyer(server).fly(spec(**DEFECT, model="none"))
    assert outcome.golden is not None
    assert outcome.digest == outcome.golden.digest
    assert outcome.injection is not None
    assert (outcome.injection.status, outcome.injection.strikes) == ("not_activated", 0)


def test_calls_that_execute_no_such_instruction_are_told(server: ForkServer) -> None:
    outcome = PairFlyer(server).fly(spec(recurrence="permanent", opcodes=["fsqrt"]))
    assert outcome.injection is not None
    assert (outcome.injection.status, outcome.injection.strikes) == ("not_activated", 0)
    assert outcome.golden is not None
    assert outcome.digest == outcome.golden.digest


@pytest.mark.soak
def test_a_node_that_dies_of_it_again_and_again_repeats(server: ForkServer) -> None:
    outcome = PairFlyer(server).fly(spec(recurrence="intermittent", probability=0.002, register_class="gpr"))
    struck(outcome)
    assert outcome.nodes["control"].crashes > 1
    assert replay(outcome, server).answer == "replayed"


@pytest.mark.soak
def test_a_thousand_strikes_cost_at_most_another_flight(server: ForkServer) -> None:
    """In turns, as the machine is busy; the least of each."""
    flyer = PairFlyer(server)
    faulty = MissionSpec(
        seed=7,
        fault=FaultSpec(
            target="pid",
            recurrence="intermittent",
            probability=0.006,
            register_class="vector",
            bit_numbers=(0,),
        ),
    )
    golden = faulty.model_copy(update={"fault": None})
    flyer.fly(golden)
    took: dict[str, list[float]] = {"golden": [], "faulty": []}
    for _ in range(3):
        begin = time.monotonic()
        PairFlyer(server).fly(golden)
        took["golden"].append(time.monotonic() - begin)
        outcome = flyer.fly(faulty)
        took["faulty"].append(outcome.wall_s)
        assert struck(outcome).strikes > 1000
    assert min(took["faulty"]) < 2 * min(took["golden"])


@pytest.mark.parametrize(
    ("changed", "problem"),
    [
        (
            {"fault": {"opcodes": ["mulsdx"]}},
            "there is no instruction 'mulsdx' on this CPU; similar: .*mulsd",
        ),
        ({"clock": "realtime"}, "virtual time: leave out --clock realtime"),
        (
            {"fault": {"recurrence": "rate", "rate_hz": 5.0}, "platform": "ideal"},
            "pid takes no time on this platform",
        ),
    ],
)
def test_what_cannot_recur_is_refused(changed: dict[str, object], problem: str) -> None:
    fault = {"target": "pid", **DEFECT}
    more = changed.pop("fault", {})
    assert isinstance(more, dict)
    fault = {**fault, **more}
    with pytest.raises(BadSpecError, match=problem):
        check(MissionSpec.model_validate({"seed": 7, "fault": fault, **changed}))
