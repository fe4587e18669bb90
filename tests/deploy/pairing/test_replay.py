"""An injected flight repeats from its own outcome, and says so when it cannot."""

import json
import os
import signal
import threading
from pathlib import Path

import pytest
from click.testing import CliRunner

from dashboard.cli import zenfi
from deploy.errors import DisturbedFlightError
from deploy.mission.flight import fly
from deploy.mission.fork_server import ForkServer
from deploy.mission.setups import armed_call, spec_for_stages
from deploy.pairing.golden_twin import PairFlyer
from deploy.pairing.replay import compare, replay
from services.models.faults.specification import FaultSpec, Site, Trigger
from services.models.mission import Limits, MissionSpec
from services.models.outcome import Outcome
from tests.conftest import descendants, forked, node, wait_until

SHORT = MissionSpec(seed=7, limits=Limits(mission_time_s=6.0))
SPEC = SHORT.model_copy(update={"fault": FaultSpec(target="pid", register_class="vector", seed=2)})


@pytest.fixture(scope="module")
def pairs(server: ForkServer) -> PairFlyer:
    return PairFlyer(server)


@pytest.fixture(scope="module")
def first(pairs: PairFlyer) -> Outcome:
    return pairs.fly(SPEC)


def site(outcome: Outcome) -> Site:
    assert outcome.spec.fault is not None
    assert outcome.spec.fault.trigger is not None
    assert outcome.spec.fault.trigger.site is not None
    return outcome.spec.fault.trigger.site


def altered(outcome: Outcome, **changes: object) -> Outcome:
    """The outcome with another site in its specification."""
    fault = outcome.spec.fault
    assert fault is not None
    assert fault.trigger is not None
    trigger = fault.trigger.model_copy(update={"site": site(outcome).model_copy(update=changes)})
    changed = fault.model_copy(update={"trigger": trigger})
    return outcome.model_copy(update={"spec": outcome.spec.model_copy(update={"fault": changed})})


def test_the_outcome_says_at_which_instruction_the_fault_struck(first: Outcome, server: ForkServer) -> None:
    assert first.injection is not None
    assert first.injection.status == "injected"
    assert first.injection.precision in ("exact", "occurrence")
    assert first.injection.probes >= 1
    assert first.injection.trigger == (first.spec.fault.trigger if first.spec.fault is not None else None)
    assert site(first).code
    assert site(first).registers
    assert not forked(server.pid)  # probes and all


def test_an_injected_flight_repeats(first: Outcome, server: ForkServer) -> None:
    answer = replay(first, server)
    assert (answer.answer, answer.differences) == ("replayed", [])


def test_a_mask_is_read_back_and_repeats(pairs: PairFlyer, server: ForkServer) -> None:
    """The histogram is in the outcome, so that nothing else is needed."""
    histogram = {"bits": {2: 0.5, 5: 0.5}}
    fault = {"target": "pid", "register_class": "vector", "mask": "histogram", "histogram": histogram}
    flown = pairs.fly(SHORT.model_copy(update={"fault": FaultSpec.model_validate(fault)}))
    record = flown.injection
    assert record is not None
    assert record.status == "injected"
    changed = int(record.before, 16) ^ int(record.read_back, 16)
    assert [bit for bit in range(record.width_bits) if changed >> bit & 1] == record.bits
    assert len(record.bits) in (2, 5)
    answer = replay(Outcome.model_validate_json(flown.model_dump_json(by_alias=True)), server)
    assert (answer.answer, answer.differences) == ("replayed", [])


def test_nothing_is_flipped_where_the_site_looks_otherwise(first: Outcome, server: ForkServer) -> None:
    answer = replay(altered(first, registers="00", relative="00"), server)
    assert answer.answer == "diverged"
    assert "registers" in answer.differences[0]


def recorded(outcome: Outcome, registers: str, **changes: object) -> Outcome:
    """The outcome with another record, of other registers at the site."""
    record = outcome.injection
    assert record is not None
    assert record.trigger is not None
    seen = site(outcome).model_copy(update={"registers": registers})
    trigger = record.trigger.model_copy(update={"site": seen})
    return outcome.model_copy(update={"injection": record.model_copy(update={**changes, "trigger": trigger})})


def test_it_strikes_where_only_pointers_differ(first: Outcome, server: ForkServer) -> None:
    """As where memory lies elsewhere: another hash of the registers, the same of what they point into."""
    elsewhere = recorded(altered(first, registers="00"), "00")
    answer = replay(elsewhere, server)
    assert answer.answer == "relocated"
    assert [told.partition(":")[0] for told in answer.differences] == ["registers at the site"]


@pytest.mark.parametrize(
    ("there", "changes", "expected"),
    [
        ("memory, 8 modulo 16", {}, "relocated"),
        ("memory, 0 modulo 16", {}, "diverged"),
        ("", {}, "diverged"),
        ("memory, 8 modulo 16", {"bits": [3]}, "diverged"),
        ("memory, 8 modulo 16", {"symbol": "other"}, "diverged"),
    ],
)
def test_a_struck_pointer_may_differ_by_where_memory_lies_and_nothing_else_may(
    first: Outcome, there: str, changes: dict[str, object], expected: str
) -> None:
    here = recorded(
        first, "01", before="0a08", after="0a18", read_back="0a18", points_into="memory, 8 modulo 16"
    )
    other = recorded(first, "02", before="0b08", after="0b18", read_back="0b18", points_into=there, **changes)
    assert compare(here, here).answer == "replayed"
    assert compare(here, other).answer == expected


@pytest.mark.parametrize(
    ("there", "expected"),
    [
        ({"before": "00", "after": "40", "read_back": "40"}, "relocated"),
        ({"before": "40", "after": "00", "read_back": "00"}, "diverged"),
        ({"before": "00", "after": "40", "read_back": "40", "bits": [2]}, "diverged"),
        ({"before": "00", "after": "40", "read_back": "40", "register_name": "rax"}, "diverged"),
    ],
)
def test_flags_beside_the_struck_one_may_be_of_a_comparison_of_pointers(
    first: Outcome, there: dict[str, object], expected: str
) -> None:
    """Seen between a checkout and a wheel: zero was struck behind a comparison, parity was another."""
    flags = {"register_name": "rflags", "bits": [6], "points_into": ""}
    here = recorded(first, "01", **{**flags, "before": "04", "after": "44", "read_back": "44"})
    other = recorded(first, "01", **{**flags, **there})
    assert compare(here, other).answer == expected


def test_another_outcome_of_a_relocated_fault_is_a_divergence(first: Outcome) -> None:
    other = recorded(first, "02").model_copy(update={"digest": "00"})
    assert compare(recorded(first, "01"), other).answer == "diverged"


def test_a_site_that_the_call_does_not_come_to_is_not_reached(first: Outcome, server: ForkServer) -> None:
    answer = replay(altered(first, hit=10**6), server)
    assert answer.answer == "not_reached"


def test_the_command_answers_for_each_flight(first: Outcome, tmp_path: Path) -> None:
    other = altered(first, code="00")
    lines = [first.model_dump_json(by_alias=True), f'{{"outcome": {other.model_dump_json(by_alias=True)}}}']
    file = tmp_path / "flights.json"
    file.write_text("\n".join(lines))
    answer = CliRunner().invoke(zenfi, ["replay", str(file), "--json"])
    assert answer.exit_code == 1
    told = [json.loads(line) for line in answer.stdout.splitlines()]
    assert [(one["flight"], one["answer"]) for one in told] == [(1, "replayed"), (2, "diverged")]
    fault = first.spec.fault
    assert fault is not None
    assert {(one["struck"], one["fault_seed"]) for one in told} == {(fault.target, fault.seed)}


def test_a_fault_at_a_time_of_the_flight_strikes_the_next_call(pairs: PairFlyer) -> None:
    fault = FaultSpec(target="octomap", seed=1, trigger=Trigger(over="time", cpu_ns=100_000))
    outcome = pairs.fly(SHORT.model_copy(update={"fault": fault}))
    record = outcome.injection
    assert record is not None
    assert record.trigger is not None
    assert record.trigger.after_ns is not None
    assert 0 <= record.virtual_time_ns - record.trigger.after_ns < 1_000_000_000
    assert record.trigger.invocation == record.invocation


@pytest.mark.parametrize(
    ("text", "says"),
    [("", "no flight"), ("{}", "line 1"), ("[1]", "line 1"), ("flight", "line 1")],
)
def test_what_is_no_outcome_is_refused(text: str, says: str, tmp_path: Path) -> None:
    file = tmp_path / "outcome.json"
    file.write_text(text)
    answer = CliRunner().invoke(zenfi, ["replay", str(file)])
    assert answer.exit_code != 0
    assert says in str(answer.exception)


PROBED = SHORT.model_copy(
    update={"fault": FaultSpec(target="octomap", scope="thread", trigger=Trigger(invocation=5))}
)
"""A call whose probe lives for a second and cannot be missed: all libraries are looked through."""


def kill_while_scouting(victim: str) -> None:
    """Kill the injector or the node once the node has sent a probe."""

    def scouting() -> bool:
        perception = node(os.getpid(), "perception")
        return perception is not None and bool(descendants(perception))

    wait_until(scouting)
    pid = node(os.getpid(), victim)
    assert pid is not None
    os.kill(pid, signal.SIGKILL)


def test_an_injector_that_is_killed_while_it_probes_leaves_nobody(server: ForkServer) -> None:
    killer = threading.Thread(target=kill_while_scouting, args=("injector",))
    killer.start()
    with pytest.raises(DisturbedFlightError, match="injector was ended from outside"):
        fly(PROBED, server)
    killer.join()
    assert not forked(server.pid)


def test_a_node_that_is_killed_while_it_probes_makes_no_outcome(server: ForkServer) -> None:
    killer = threading.Thread(target=kill_while_scouting, args=("perception",))
    killer.start()
    with pytest.raises(DisturbedFlightError, match="perception was ended from outside"):
        fly(PROBED, server)
    killer.join()
    assert not forked(server.pid)


def test_stages_are_told_no_more_of_a_replayed_fault_than_of_the_first(first: Outcome) -> None:
    """What they are told lies in their memory, which has to be the same."""
    before = altered(first, code="", registers="").spec
    assert first.spec != before
    assert spec_for_stages(first.spec) == spec_for_stages(before)
    assert first.spec.fault is not None
    assert spec_for_stages(first.spec).fault == FaultSpec(target=first.spec.fault.target)
    assert first.injection is not None
    assert armed_call(first.spec.fault) == Trigger(invocation=first.injection.invocation)
