"""The quickest way to an instruction of a call all of whose instructions were stepped through."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise

from injector.isa.host import decode
from injector.isa.instruction import DecodeError
from injector.tracing.elf import place
from injector.tracing.process import CodeError, Process
from services.models.faults.specification import Site

MOST_STEPS = 150_000
"""Instructions after which a call counts as too long to be stepped through: some 3 s of wall time."""

WINDOW = 2_000
"""Most single steps from a breakpoint to the site."""

STEPS_A_HIT = 0.4
"""What a pass through a breakpoint costs, in single steps."""


def approach(process: Process, trace: Sequence[int], step: int) -> Site:
    """The site by which an instruction is reached fastest, in a call whose instructions are all known."""
    least = max(0, step - WINDOW)
    passes = Counter(trace[:least])
    best, cost, hit = -1, float(step), 0
    usable = _breakable(process, trace[least : step + 1])
    for at in range(least, step + 1):
        passes[trace[at]] += 1
        costs = passes[trace[at]] * STEPS_A_HIT + step - at
        if usable[at - least] and costs < cost:
            best, cost, hit = at, costs, passes[trace[at]]
    if best < 0:
        return Site(precision="exact", steps=step)
    there = place(process.pid, process.maps(), trace[best])
    return Site(
        precision="exact",
        module=there.module,
        build_id=there.build_id,
        offset=there.offset,
        hit=hit,
        steps=step - best,
    )


def _breakable(process: Process, trace: Sequence[int]) -> list[bool]:
    """Where a breakpoint may stand from which the end of the trace is reached in single steps.

    Not where an instruction follows on itself, whose repetitions the processor may count as one pass,
    and not before a system call.
    """
    repeating = {one for one, other in pairwise(trace) if one == other}
    steppable = {address: _steppable(process, address) for address in set(trace)}
    usable = [address not in repeating for address in trace]
    for at in range(len(trace) - 2, -1, -1):
        if not steppable[trace[at]]:
            usable[: at + 1] = [False] * (at + 1)
            break
    return usable


def _steppable(process: Process, address: int) -> bool:
    try:
        return decode(process.read_code(address), address).steppable
    except (CodeError, DecodeError):
        return False
