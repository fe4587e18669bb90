"""When a fault that recurs strikes: which executions of its instructions, in each call of the kernel.

Everything is drawn for one call, from the fault's seed and the call's number: a node that was started again
goes on where the one before it died.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from services.models.fault_spec import FaultSpec
from services.runtime import rng

_BLOCK = 64


def intermittent_gaps(fault: FaultSpec, seed: int, invocation: int) -> Iterator[int]:
    """How many executions it is to each strike of a call from the one before, the struck one included.

    Each execution is struck with the fault's ``probability``, so these numbers are geometric. They have no
    memory: it is the same law that each call begins anew.
    """
    draw = rng.generator(seed, f"executions {fault.target}", fault.seed, invocation)
    while True:
        yield from draw.geometric(fault.probability or 1.0, _BLOCK).tolist()


def upsets(fault: FaultSpec, seed: int, invocation: int, latency_ns: int) -> NDArray[np.float64]:
    """When upsets come in a call, as parts of the time that it takes, in order: a Poisson process."""
    draw = rng.generator(seed, f"upsets {fault.target}", fault.seed, invocation)
    number = draw.poisson((fault.rate_hz or 0.0) * latency_ns / 1e9)
    return np.sort(draw.random(number))


def upset_executions(parts: NDArray[np.float64], executions: int) -> list[int]:
    """The executions, counted from 1, in which upsets at these parts of a call are.

    The call's executions share its time alike. Two upsets in one strike it and its next neighbour; of a call
    with fewer executions than upsets each is struck.
    """
    number = min(len(parts), executions)
    found = np.floor(parts[:number] * executions).astype(np.int64) + 1
    place = np.arange(number)
    found = np.maximum.accumulate(found - place) + place
    return [int(one) for one in np.minimum(found, executions - number + 1 + place)]


def gaps(executions: list[int]) -> Iterator[int]:
    """How many executions it is to each from the one before."""
    before = 0
    for one in executions:
        yield one - before
        before = one


def draw_of_strike(fault: FaultSpec, seed: int, invocation: int, number: int) -> np.random.Generator:
    """What operand and bits of a call's ``number``-th strike are drawn from."""
    return rng.generator(seed, f"strike {fault.target}", fault.seed, invocation, number)


def draws_of_defect(fault: FaultSpec, seed: int) -> tuple[np.random.Generator, np.random.Generator]:
    """What operand and bits of a permanent defect are drawn from: the same for each instruction.

    Instructions that access operands of one kind are struck in the same bits of it.
    """
    operand, bits = (
        rng.generator(seed, f"defect {what} {fault.target}", fault.seed) for what in ("operand", "bits")
    )
    return operand, bits
