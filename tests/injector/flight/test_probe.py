"""Probes tell which instruction to strike, the call then reaches that very one, and none of them is left."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from services.models.faults.specification import Site
from tests.conftest import alive, descendants
from tests.injector.calls import LOOP, aimed_at_a_source, caller, registers_in_the_loop

pytestmark = pytest.mark.usefixtures("may_inject")

PASSES = 400


def test_probes_of_one_call_take_the_same_way() -> None:
    with caller(PASSES) as one:
        traces = []
        for _ in range(2):
            addresses = one.trace()
            assert addresses.count(one.loop) == PASSES
            # The interpreter's way into the call depends a little on what it did before.
            traces.append(addresses[addresses.index(one.loop) :][: 3 * PASSES])
        assert traces[0] == traces[1]


@pytest.mark.parametrize("hit", [1, 3, PASSES])
def test_the_occurrence_rung_strikes_the_drawn_pass(hit: int) -> None:
    with caller(PASSES) as one:
        record = one.inject(aimed_at_a_source(Site(precision="occurrence", offset=one.loop, hit=hit)))
        assert (record.status, record.precision, record.instruction) == ("injected", "occurrence", LOOP)
        found = registers_in_the_loop(PASSES, hit)
        assert int(record.before, 16) == found[record.register_name]
        if record.register_name == "rax":
            (bit,) = record.bits
            rest = sum(range(found["rcx"] + 1))
            assert one.result() == (found["rax"] ^ 1 << bit) + rest & 2**64 - 1


def test_a_call_that_is_over_before_the_pass_is_not_reached() -> None:
    with caller(PASSES) as one:
        record = one.inject(aimed_at_a_source(Site(precision="occurrence", offset=one.loop, hit=PASSES + 1)))
        assert (record.status, record.bits) == ("not_reached", [])
        assert f"{PASSES} of {PASSES + 1}" in record.reason
        assert one.result() == one.right


@pytest.mark.parametrize("field", ["code", "registers"])
def test_nothing_is_flipped_where_the_site_looks_otherwise(field: str) -> None:
    with caller(PASSES) as one:
        site = Site(precision="occurrence", offset=one.loop, hit=7).model_copy(update={field: "00"})
        record = one.inject(aimed_at_a_source(site))
        assert (record.status, record.bits) == ("diverged", [])
        assert one.result() == one.right


def test_code_that_is_not_loaded_is_told() -> None:
    with caller(PASSES) as one:
        record = one.inject(
            aimed_at_a_source(Site(precision="occurrence", module="libnowhere.so", offset=16, hit=7))
        )
        assert record.status == "diverged"
        assert "libnowhere.so" in record.reason
        assert one.result() == one.right


def test_the_same_site_is_found_again_by_what_was_seen_there() -> None:
    records = []
    site = Site(precision="occurrence", hit=11)
    for _ in range(2):
        with caller(PASSES) as one:
            record = one.inject(aimed_at_a_source(site.model_copy(update={"offset": one.loop})))
            records.append(record)
            assert record.trigger is not None
            assert record.trigger.site is not None
            site = record.trigger.site
    assert records[0].status == records[1].status == "injected"
    assert (records[0].register_name, records[0].bits) == (records[1].register_name, records[1].bits)
    assert records[0].before == records[1].before


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
        one.tracees.trace(one.thread, 100)
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
