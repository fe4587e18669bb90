"""Looking for an instruction that the fault can strike, and striking it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from injector.acts import ACTS, Act
from injector.freeze import Tracees
from injector.inject import Standing, Strike, TargetError, stand
from injector.process import AddressError, CodeError, Process
from injector.ptrace import GoneError
from injector.scope import within
from injector.thread import Thread
from services.bus.mission import FaultSpec

SITES = 1000
"""Instructions in the scope with nothing eligible that are passed over before we give up."""

OUTSIDE = 20_000
"""Instructions outside the scope that are passed over before we give up: a second, at worst."""

LINGER = 256
"""Most instructions of the scope that are passed over on coming into it: it is not always to be the first."""


def strike(
    tracees: Tracees,
    thread: Thread,
    process: Process,
    fault: FaultSpec,
    draw: np.random.Generator,
    act: Act | None = None,
    stop: Callable[[], object] = lambda: None,
    go: Callable[[], object] = lambda: None,
) -> Strike | None:
    """Do to a standing thread what ``fault`` says, at its next instruction within the scope that offers it.

    What is struck is drawn uniformly from what is eligible: pairs of register and role, or of memory word
    and role; then the number within it, if a field is asked for; then the bits. A source is struck before
    the instruction, a destination after it (after one iteration, if it repeats). ``act`` takes the place of
    what the fault's model does. ``stop``, which is to stop everybody else, is called before anything is
    changed and not earlier: what can be drawn while the others still run need not hold them up. ``go``, which
    is to let everybody go, the thread too, may be called before this returns, not to hold them up by telling.

    None: the thread is in a system call or about to enter one (or to show the program that it is being
    stepped). That is no user instruction; the thread must run on first.
    """
    inside = within(fault, process)
    act = act or ACTS[fault.model]
    without = outside = lingered = linger = 0
    try:
        while without < SITES and outside < OUTSIDE:
            registers, instruction = stand(thread, process)
            if registers.in_system_call or not instruction.steppable:
                return None
            standing = Standing(tracees, thread, process, registers, instruction, stop, go)
            if not inside(instruction.address):
                linger = linger if outside else int(draw.integers(LINGER + 1))
                outside += 1
            elif lingered < linger:
                lingered += 1
            elif found := act(standing, fault, draw):
                return replace(found, passed_over=without + outside + lingered)
            else:
                without += 1
            standing.execute()
    except (TargetError, GoneError, CodeError) as error:
        return Strike("failed", f"before the fault: {error}", passed_over=without + outside + lingered)
    except AddressError as error:
        return Strike("failed", str(error), passed_over=without + outside + lingered)
    what = "nothing eligible" if without == SITES else "none of the kernel's own code"
    reason = f"{what} in {SITES if without == SITES else OUTSIDE} instructions"
    return Strike("not_activated", reason, passed_over=without + outside + lingered)
