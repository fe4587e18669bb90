"""Apply a fault to a stopped thread: step to an instruction with an eligible operand and corrupt it there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from injector.faults.code_scope import within
from injector.faults.corruption import CORRUPTIONS, Corruption
from injector.faults.stopped_thread import InjectionResult, StoppedThread, TargetError, stand
from injector.tracing.process import AddressError, CodeError, Process
from injector.tracing.ptrace import GoneError
from injector.tracing.tracee import Tracee
from injector.tracing.tracees import TraceeGroup
from services.models.faults.specification import FaultSpec

SITES = 1000
"""Instructions in the scope with nothing eligible that are passed over before we give up."""

OUTSIDE = 20_000
"""Instructions outside the scope that are passed over before we give up: a second, at worst."""

LINGER = 256
"""Most instructions of the scope that are passed over on coming into it: it is not always to be the first."""


def apply_fault(
    tracees: TraceeGroup,
    thread: Tracee,
    process: Process,
    fault: FaultSpec,
    draw: np.random.Generator,
    corruption: Corruption | None = None,
    stop: Callable[[], object] = lambda: None,
    go: Callable[[], object] = lambda: None,
) -> InjectionResult | None:
    """Corrupt a stopped thread as ``fault`` says, at its next instruction within the scope that is eligible.

    What is corrupted is drawn uniformly from what is eligible: pairs of register and role, or of memory word
    and role; then the number within it, if a field is asked for; then the bits. A source is corrupted before
    the instruction, a destination after it (after one iteration, if it repeats). ``corruption`` takes the
    place of what the fault's model does. ``stop``, which is to stop everybody else, is called before anything
    is changed and not earlier: what can be drawn while the others still run need not hold them up. ``go``,
    which is to let everybody go, the thread too, may be called before this returns, not to hold them up by
    telling.

    None: the thread is in a system call or about to enter one (or to show the program that it is being
    stepped). That is no user instruction; the thread must run on first.
    """
    inside = within(fault, process)
    corruption = corruption or CORRUPTIONS[fault.model]
    without = outside = lingered = linger = 0
    try:
        while without < SITES and outside < OUTSIDE:
            registers, instruction = stand(thread, process)
            if registers.in_system_call or not instruction.steppable:
                return None
            standing = StoppedThread(tracees, thread, process, registers, instruction, stop, go)
            if not inside(instruction.address):
                linger = linger if outside else int(draw.integers(LINGER + 1))
                outside += 1
            elif lingered < linger:
                lingered += 1
            elif found := corruption(standing, fault, draw):
                return replace(found, passed_over=without + outside + lingered)
            else:
                without += 1
            standing.execute()
    except (TargetError, GoneError, CodeError) as error:
        return InjectionResult(
            "failed", f"before the fault: {error}", passed_over=without + outside + lingered
        )
    except AddressError as error:
        return InjectionResult("failed", str(error), passed_over=without + outside + lingered)
    what = "nothing eligible" if without == SITES else "none of the kernel's own code"
    reason = f"{what} in {SITES if without == SITES else OUTSIDE} instructions"
    return InjectionResult("not_activated", reason, passed_over=without + outside + lingered)
