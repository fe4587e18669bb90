"""Probes tell which instruction to strike, the call then reaches that very one, and none of them is left."""

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import pytest
from scipy.stats import chisquare

from injector.flight import probe as scouting
from injector.flight.probe import ProbeRun, approach, draw_site, rarest
from injector.tracing.process import Process
from services.models.mission import FaultSpec, Site, Trigger
from services.runtime.rng import generator
from tests.conftest import alive, descendants
from tests.injector.calls import LOOP, Caller, caller

pytestmark = pytest.mark.usefixtures("may_inject")

PASSES = 400


def at(site: Site) -> FaultSpec:
    return FaultSpec(
        target="kernel", operand="source", register_class="gpr", trigger=Trigger(invocation=0, site=site)
    )


def in_the_loop(passing: int) -> dict[str, int]:
    """What its registers hold before the instruction's ``passing``-th execution."""
    left = PASSES - passing + 1
    return {"rcx": left, "rax": sum(range(left + 1, PASSES + 1))}


def test_probes_of_one_call_take_the_same_way() -> None:
    with caller(PASSES) as one:
        traces = []
        for _ in range(2):
            with one.ahead() as probe:
                addresses, ended = probe.trace(scouting.MOST_STEPS)
            assert ended
            assert addresses.count(one.loop) == PASSES
            # The interpreter's way into the call depends a little on what it did before.
            traces.append(addresses[addresses.index(one.loop) :][: 3 * PASSES])
        assert traces[0] == traces[1]


@pytest.mark.parametrize("seed", range(4))
def test_the_exact_rung_strikes_the_drawn_step_of_all(seed: int) -> None:
    with caller(PASSES) as one:
        with one.ahead() as probe:
            every, _ = probe.trace(scouting.MOST_STEPS)
        trigger = draw_site(one.probes, Trigger(invocation=0), generator(seed, "site"))
        assert trigger.site is not None
        assert trigger.site.precision == "exact"
        assert trigger.site.step is not None
        fault = FaultSpec(target="kernel", trigger=trigger)
        record = one.inject(fault, seed)
        assert record.status == "injected", record.reason
        if not record.resampled and not record.module:
            assert record.offset == every[trigger.site.step]
        assert record.trigger is not None
        assert record.trigger.site is not None
        assert record.trigger.site.code


@pytest.mark.parametrize("passing", [1, 2, 77, PASSES])
def test_every_way_to_a_step_ends_at_it(passing: int) -> None:
    """By the quickest way and by steps from the first pass: told by what the loop has in ecx."""
    with caller(PASSES) as one:
        with one.ahead() as probe:
            every, _ = probe.trace(scouting.MOST_STEPS)
            step = [number for number, address in enumerate(every) if address == one.loop][passing - 1]
            quickest = approach(probe.process, every, step)
        record = one.inject(at(quickest), passing)
        assert (record.status, record.instruction) == ("injected", LOOP)
        assert int(record.before, 16) == in_the_loop(passing)[record.register_name]
    with caller(PASSES) as one:
        walked = Site(precision="exact", offset=one.loop, hit=1, steps=3 * (passing - 1))
        record = one.inject(at(walked), passing)
        assert (record.status, record.instruction) == ("injected", LOOP)
        assert int(record.before, 16) == in_the_loop(passing)[record.register_name]


@pytest.mark.parametrize("hit", [1, 3, PASSES])
def test_the_occurrence_rung_strikes_the_drawn_pass(hit: int) -> None:
    with caller(PASSES) as one:
        record = one.inject(at(Site(precision="occurrence", offset=one.loop, hit=hit)))
        assert (record.status, record.precision, record.instruction) == ("injected", "occurrence", LOOP)
        found = in_the_loop(hit)
        assert int(record.before, 16) == found[record.register_name]
        if record.register_name == "rax":
            (bit,) = record.bits
            rest = sum(range(found["rcx"] + 1))
            assert one.result() == (found["rax"] ^ 1 << bit) + rest & 2**64 - 1


def test_a_long_call_is_struck_by_occurrence() -> None:
    with caller(3_000_000) as one:
        trigger = draw_site(one.probes, Trigger(invocation=0), generator(0, "site"))
    # The loop passes each of its instructions far too often to be counted: thread time is left.
    assert trigger.site is None
    assert trigger.cpu_ns is not None
    with caller(60_000) as one:
        trigger = draw_site(one.probes, Trigger(invocation=0), generator(0, "site"))
        assert trigger.site is not None
        assert trigger.site.precision == "occurrence"
        assert one.inject(FaultSpec(target="kernel", trigger=trigger)).status == "injected"


def in_its_own_code(one: Caller) -> Callable[[Process], Callable[[int], bool]]:
    """The machine code of the call: four bytes before the loop, six after its first instruction."""
    return lambda _: lambda address: one.loop - 4 <= address < one.loop + 8


@dataclass(frozen=True, slots=True)
class Recorded(ProbeRun):
    """A probe whose call is run once, for many draws."""

    every: list[int]
    took_ns: int = 0

    def run(self) -> int:
        return self.took_ns

    def trace(self, most: int) -> tuple[list[int], bool]:
        assert most > len(self.every)
        return self.every, True


def test_a_short_call_is_struck_exactly_on_a_slow_machine_too() -> None:
    with caller(PASSES) as one, one.ahead() as probe:
        every, _ = probe.trace(scouting.FEW_STEPS)
        slow = Recorded(probe.tracees, probe.thread, probe.process, every, took_ns=5_000_000)
        trigger = draw_site(lambda: nullcontext(slow), Trigger(), generator(0, "site"))
    assert trigger.site is not None
    assert trigger.site.precision == "exact"


def test_within_a_scope_the_exact_rung_draws_all_its_instructions_alike() -> None:
    passes, draws = 5, 200
    with caller(passes) as one, one.ahead() as probe:
        every, ended = probe.trace(scouting.MOST_STEPS)
        assert ended
        own = [step for step, address in enumerate(every) if one.loop - 4 <= address < one.loop + 8]
        assert len(own) == 2 + 3 * passes + 1
        assert len(every) > 2 * len(own)
        recorded = Recorded(probe.tracees, probe.thread, probe.process, every)
        draw, drawn = generator(0, "scope"), Counter[int]()
        for _ in range(draws):
            trigger = draw_site(lambda: nullcontext(recorded), Trigger(), draw, in_its_own_code(one))
            assert trigger.site is not None
            assert trigger.site.step is not None
            drawn[trigger.site.step] += 1
        assert set(drawn) <= set(own)
        assert chisquare([drawn[step] for step in own]).pvalue > 0.01


@pytest.mark.soak
@pytest.mark.parametrize(("passes", "precision"), [(PASSES, "exact"), (60_000, "occurrence")])
def test_within_a_scope_the_site_is_there_whatever_the_rung(passes: int, precision: str) -> None:
    struck = 0
    for seed in range(12):
        with caller(passes) as one:
            trigger = draw_site(
                one.probes, Trigger(invocation=0), generator(seed, "site"), in_its_own_code(one)
            )
            if trigger.site is None:  # so short a call may be over before the drawn moment of it
                assert precision == "occurrence"
                continue
            assert trigger.site.precision == precision
            record = one.inject(FaultSpec(target="kernel", operand="source", trigger=trigger), seed)
            assert record.status == "injected"
            assert record.instruction.split()[0] in ("xor", "mov", "add", "dec", "jne", "ret")
            struck += 1
        if struck == 2:
            return
    pytest.fail("struck too seldom")


def test_a_call_that_is_over_before_the_pass_is_not_reached() -> None:
    with caller(PASSES) as one:
        record = one.inject(at(Site(precision="occurrence", offset=one.loop, hit=PASSES + 1)))
        assert (record.status, record.bits) == ("not_reached", [])
        assert f"{PASSES} of {PASSES + 1}" in record.reason
        assert one.result() == one.right


@pytest.mark.parametrize("field", ["code", "registers"])
def test_nothing_is_flipped_where_the_site_looks_otherwise(field: str) -> None:
    with caller(PASSES) as one:
        site = Site(precision="occurrence", offset=one.loop, hit=7).model_copy(update={field: "00"})
        record = one.inject(at(site))
        assert (record.status, record.bits) == ("diverged", [])
        assert one.result() == one.right


def test_code_that_is_not_loaded_is_told() -> None:
    with caller(PASSES) as one:
        record = one.inject(at(Site(precision="occurrence", module="libnowhere.so", offset=16, hit=7)))
        assert record.status == "diverged"
        assert "libnowhere.so" in record.reason
        assert one.result() == one.right


def test_the_same_site_is_found_again_by_what_was_seen_there() -> None:
    records = []
    site = Site(precision="occurrence", hit=11)
    for _ in range(2):
        with caller(PASSES) as one:
            record = one.inject(at(site.model_copy(update={"offset": one.loop})))
            records.append(record)
            assert record.trigger is not None
            assert record.trigger.site is not None
            site = record.trigger.site
    assert records[0].status == records[1].status == "injected"
    assert (records[0].register_name, records[0].bits) == (records[1].register_name, records[1].bits)
    assert records[0].before == records[1].before


def test_a_probe_that_had_to_be_killed_tells_of_no_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scouting, "LIMIT_S", 0.5)
    with caller(10**9) as one:
        with one.ahead() as probe:
            addresses, ended = probe.trace(10**9)
        assert addresses
        assert not ended
        with one.ahead() as probe:
            assert probe.count(one.loop) == 0


def test_the_rarest_address_of_a_trace_is_passed_last() -> None:
    with caller(1) as one, one.ahead() as probe:
        every, _ = probe.trace(3000)
        index = rarest(probe.process, every[:2000])
        assert every[:2000].count(every[index]) == min(every[:2000].count(one) for one in every[index:2000])


def test_no_probe_is_left_behind() -> None:
    with caller(PASSES) as one:
        with one.ahead() as probe:
            pid = probe.thread.pid
            assert pid in descendants(one.pid)
        assert not alive(pid)
        one.tell("pass")
        assert one.result() == one.right


KILLED = """
import sys
from injector.flight.probe import sent_ahead
from services.bus.announce import Announcement, boot_id, start_ticks
pid = int(sys.argv[1])
node = Announcement("node", pid, pid, start_ticks(pid), boot_id())
with sent_ahead(node, lambda: print("send", flush=True)) as one:
    while True:
        one.trace(100)
"""


def test_a_node_whose_injector_is_killed_while_it_probes_goes_on() -> None:
    with caller(PASSES) as one:
        injector = subprocess.Popen(
            [sys.executable, "-c", KILLED, str(one.pid)],
            cwd=Path(__file__).parents[3],
            stdout=subprocess.PIPE,
        )
        assert injector.stdout is not None
        assert injector.stdout.readline() == b"send\n"
        one.tell("probe")
        time.sleep(0.05)
        os.kill(injector.pid, signal.SIGKILL)
        injector.communicate()
        assert one.line() == "gate\n"
        assert not descendants(one.pid)
        one.tell("pass")
        assert one.result() == one.right
