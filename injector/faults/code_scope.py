"""Address ranges of a kernel's own code, without the interpreter and other libraries that its thread runs."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from pathlib import Path

from injector.tracing.elf import code_sections
from injector.tracing.process import MemoryMap, Process
from services.kernels import find_kernel, scope_of
from services.models.faults.specification import FaultSpec


def within(fault: FaultSpec, process: Process) -> Callable[[int], bool]:
    """A test of addresses: whether the fault may be injected into the instruction there."""
    if scope_of(fault) == "thread":
        return lambda _: True
    ranges = code_ranges(process.maps(), _modules(fault))
    starts = [start for start, _ in ranges]

    def inside(address: int) -> bool:
        index = bisect_right(starts, address) - 1
        return index >= 0 and address < ranges[index][1]

    return inside


def countable_code(fault: FaultSpec, process: Process) -> list[tuple[int, int]]:
    """Where the code lies, in order, of which the fault strikes an instruction.

    Without what the process may write to (code that it makes itself) and what the kernel gives to everyone.
    """
    maps = process.maps()
    pieces = [one for one in maps.code() if "w" not in one.permissions and not one.name.startswith("[")]
    if scope_of(fault) == "kernel":
        own = set(code_ranges(maps, _modules(fault)))
        pieces = [one for one in pieces if (one.start, one.end) in own]
    return sorted(section for one in pieces for section in code_sections(process.pid, one))


def _modules(fault: FaultSpec) -> tuple[str, ...]:
    kernel = find_kernel(fault.target)
    assert kernel is not None  # noqa: S101 - scope kernel goes with kernels
    return kernel.modules


def code_ranges(maps: MemoryMap, modules: tuple[str, ...]) -> list[tuple[int, int]]:
    """Where a kernel's own code lies, in order.

    That is in files whose names begin with one of ``modules``, and in executable memory without a file,
    where numba's code is: of every kernel of the process, and what else is compiled at run time.
    """
    return [
        (one.start, one.end)
        for one in maps.code()
        if not one.name or (modules and Path(one.path).name.startswith(modules))
    ]
