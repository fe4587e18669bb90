"""Copies go on alike if, and only if, what may be read later is the same in them."""

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from injector.faults.stopped_thread import registers_of
from injector.strikes.own_ends import stack_pointer
from injector.strikes.state import CopyState, difference, own_pages, state_of
from injector.tracing.process import Process, ProcessIdentity
from injector.tracing.tracee import Tracee
from tests.injector.forked_calls import Standing, standing

pytestmark = pytest.mark.usefixtures("may_inject")

KERNEL = """
static volatile double kept[4096], never[4096];
double kernel(void) {
    double sum = 0;
    for (int i = 0; i < 100; i++) { kept[i] = i * 0.5; sum += kept[i]; }
    return sum + never[0] * 0;
}
"""


@pytest.fixture
def one(tmp_path: Path) -> Iterator[Standing]:
    with standing(tmp_path, KERNEL) as made:
        yield made


@contextmanager
def at_the_end(one: Standing) -> Iterator[tuple[Tracee, Process]]:
    """A copy at the mark that ends its call."""
    copy = one.forks.copy(one.root)
    one.tracees.resume(copy)
    while copy.report is None:
        one.tracees.service()
    with Process(ProcessIdentity.of(copy.pid)) as process:
        yield copy, process
    one.forks.end(copy)


def seen(one: Standing, address: int = 0, content: bytes = b"", register: str = "") -> CopyState:
    """The state of a copy at the end of the call, changed there."""
    with at_the_end(one) as (copy, process):
        if content:
            process.write_memory(address, content)
        if register:
            registers = registers_of(copy)
            registers.put(register, int(registers.get(register)) ^ 1)
            registers.commit()
        return state_of(copy, process)


def told(one: Standing, state: CopyState, golden: CopyState) -> str:
    with Process(ProcessIdentity.of(one.root.pid)) as root:
        return difference(state, golden, root)


def array(one: Standing) -> int:
    """Where the kernel keeps its numbers."""
    with at_the_end(one) as (_, process):
        for page in sorted(own_pages(process)):
            found = process.read_memory(page, 4096).find(struct.pack("<3d", 0.5, 1.0, 1.5))
            if found >= 0:
                return page + found
    raise AssertionError("it has not written them")


def test_untouched_copies_are_the_same(one: Standing) -> None:
    assert told(one, seen(one), seen(one)) == ""


def test_a_written_number_tells_and_the_same_one_tells_the_same(one: Standing) -> None:
    golden, there = seen(one), array(one)
    other = told(one, seen(one, there, b"\x01"), golden)
    assert other
    assert told(one, seen(one, there, b"\x01"), golden) == other
    assert told(one, seen(one, there, b"\x02"), golden) != other
    assert told(one, seen(one, there + 8, b"\x01"), golden) != other


def test_a_page_that_only_one_has_written_tells_unless_it_is_as_before(one: Standing) -> None:
    golden, there = seen(one), array(one) + 8 * 4096
    assert told(one, seen(one, there, b"\x01"), golden)
    assert told(one, seen(one, there, b"\x00"), golden) == ""


def test_memory_below_the_stack_is_nobodys(one: Standing) -> None:
    golden = seen(one)
    with at_the_end(one) as (copy, _):
        end = stack_pointer(copy)
    assert told(one, seen(one, end - 129, b"\xa5"), golden) == ""
    assert told(one, seen(one, end - 127, b"\xa5"), golden)


def test_a_stack_that_has_grown_in_one_alone_tells(one: Standing) -> None:
    golden = seen(one)
    with at_the_end(one) as (copy, process):
        stack = process.maps().at(stack_pointer(copy))
    assert stack is not None
    grown = seen(one, stack.start - 8, b"\xa5")
    assert grown.extents != golden.extents
    assert told(one, grown, golden) != ""
    assert told(one, golden, grown) != ""
    assert told(one, seen(one), golden) == "", "the root's stack has grown"


@pytest.mark.parametrize(
    ("register", "tells"), [("rbx", True), ("r15", True), ("rcx", False), ("xmm7", False)]
)
def test_registers_that_a_system_call_keeps_tell(one: Standing, register: str, tells: bool) -> None:
    golden = seen(one)
    assert bool(told(one, seen(one, register=register), golden)) == tells
