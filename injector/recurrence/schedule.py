"""When a fault that recurs strikes: which executions of its instructions, in each call of the kernel.

Everything is drawn for one call, from the fault's seed and the call's number: a node that was started again
goes on where the one before it died.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from services.models.faults.specification import FaultSpec
from services.runtime import rng

_BLOCK = 64


def chance(fault: FaultSpec, latency_ns: int, executions: int) -> float:
    """The chance of each execution in a call to be struck, of a fault that is intermittent or has a rate.

    Upsets are a Poisson process in the time that the kernel takes. A call of as many ``executions`` as are
    expected takes its latency; one of more takes longer in proportion. So each execution takes a part of it,
    and is struck if an upset comes then.
    """
    if fault.probability is not None:
        return fault.probability
    expected = (fault.rate_hz or 0.0) * latency_ns / 1e9
    return -math.expm1(-expected / executions) if executions else 0.0


def gaps(fault: FaultSpec, seed: int, invocation: int, probability: float) -> Iterator[int]:
    """How many executions it is to each strike of a call from the one before, the struck one included.

    Each execution is struck with the ``probability``, independent of the others, so these numbers are
    geometric. They have no memory: it is the same law that each call begins anew.
    """
    if not probability:
        return
    draw = rng.generator(seed, f"executions {fault.target}", fault.seed, invocation)
    while True:
        yield from draw.geometric(probability, _BLOCK).tolist()


def draw_of_strike(fault: FaultSpec, seed: int, invocation: int, number: int) -> np.random.Generator:
    """What operand and bits of a call's ``number``-th strike are drawn from."""
    return rng.generator(seed, f"strike {fault.target}", fault.seed, invocation, number)


def draws_of_defect(fault: FaultSpec, seed: int) -> tuple[np.random.Generator, np.random.Generator]:
    """What operand and bits of a permanent defect are drawn from: the same for each instruction.

    Instructions that access operands of one kind are struck in the same bits of it.
    """
    return (
        rng.generator(seed, f"defect operand {fault.target}", fault.seed),
        rng.generator(seed, f"defect bits {fault.target}", fault.seed),
    )
