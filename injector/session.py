"""One injection from beginning to end: everybody is stopped, one is corrupted, all go on untraced."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from injector.elf import place
from injector.freeze import Thread, Tracees
from injector.inject import Strike, TargetError, stand, step
from injector.process import Identity, IdentityError, Maps, Process, VanishedError
from injector.ptrace import GoneError, wait_until
from injector.strike import strike
from injector.trigger import ThreadTimer, await_trap
from services.bus.announce import Announcement
from services.bus.mission import FaultSpec
from services.bus.node import GATE_SIGNAL
from services.bus.outcome import InjectionRecord

JITTER_STEPS = 64
"""Most single steps after the trap: a trap strikes at an interrupt, and not at every instruction alike."""

SYSTEM_CALLS = 16
"""System calls met at the drawn moment that are let pass before we give up."""

RERUN_NS = 100_000
"""Longest thread time from a system call to the next attempt."""


@dataclass(frozen=True, slots=True)
class Call:
    """The call of a kernel that a fault is aimed at, while it is under way.

    ``armed`` is called once, when everybody is traced. A target that is ``marked`` tells by signals to
    itself where the call begins and ends (``Node.kernel``), and its thread time counts from the first;
    else it counts from ``armed`` on, and ``finished``, asked about every millisecond, tells the end.
    """

    target: Announcement
    virtual_time_ns: int
    armed: Callable[[], None]
    finished: Callable[[], bool] = lambda: False
    marked: bool = False


def inject_at_cpu_time(
    call: Call,
    others: Sequence[Announcement],
    fault: FaultSpec,
    draw: np.random.Generator,
    limit_s: float = 60.0,
) -> InjectionRecord:
    """Inject ``fault`` once the target's thread has used ``fault.trigger.cpu_ns`` of its own time.

    All threads of the target and of ``others`` (the injector's own process is none of them) stand while
    the bit is flipped; processes of ``others`` that are gone meanwhile are left out. When this returns or
    raises, nobody is traced. ``draw`` decides on jitter, register and bit. ``limit_s`` is wall time.

    :raises IdentityError: if a process is not what it was announced as, or the target is gone.
    :raises NotPermittedError, TriggerError: if the kernel forbids tracing or timing.
    :raises FreezeError: if a thread cannot be stopped.
    :raises ValueError: if the fault has no trigger.
    """
    if fault.trigger is None:
        raise ValueError("a fault without a trigger cannot be injected: draw one first")
    with ExitStack() as held:
        bystanders = []
        for one in others:
            with suppress(VanishedError):
                bystanders.append(held.enter_context(Process(Identity.announced(one))))
        target = held.enter_context(Process(Identity.announced(call.target)))
        with Tracees(GATE_SIGNAL) as tracees:
            thread = _seize(tracees, target, bystanders, call.target.tid)
            try:
                found, maps = _reach(tracees, thread, target, call, fault, draw, limit_s)
            except GoneError:
                found, maps = Strike("failed", "the target died before the fault"), Maps("")
            except TargetError as error:
                found, maps = Strike("failed", f"before the fault: {error}"), Maps("")
        return _record(call, fault, tracees, found, maps)


def _seize(tracees: Tracees, target: Process, bystanders: Sequence[Process], tid: int) -> Thread:
    """Seize everybody, the target last; its thread ``tid``. Only now that they are held are checks final."""
    tracees.seize([process.pid for process in [*bystanders, target]])
    for process in bystanders:
        with suppress(VanishedError):
            process.verify()
    target.verify()
    thread = tracees.threads.get(tid)
    if thread is None or thread.pid != target.pid:
        message = f"process {target.pid} has no thread {tid}"
        raise IdentityError(message)
    return thread


def _reach(
    tracees: Tracees,
    thread: Thread,
    target: Process,
    call: Call,
    fault: FaultSpec,
    draw: np.random.Generator,
    limit_s: float,
) -> tuple[Strike, Maps]:
    """Wait for the moment and strike; with the memory map at that moment, which a crash would take away."""
    wait_ns = fault.trigger.cpu_ns if fault.trigger is not None else 0
    call.armed()
    if call.marked and not _at_the_mark(tracees, thread, limit_s):
        return Strike("failed", "the target never began the call"), Maps("")
    for system_calls in range(SYSTEM_CALLS):
        with ThreadTimer(thread, wait_ns) as timer:
            tracees.resume_all()
            end = await_trap(tracees, thread, timer, call.finished, limit_s)
            spent_ns = timer.spent_ns
        if end != "trapped":
            return _missed(end, system_calls, spent_ns, wait_ns, limit_s), Maps("")
        maps = target.maps()
        _jitter(tracees, thread, target, int(draw.integers(JITTER_STEPS + 1)))
        tracees.stop_all()
        found = strike(tracees, thread, target, fault, draw)
        if found is not None:
            return replace(found, passed_over=found.passed_over + system_calls), maps
        wait_ns = int(draw.integers(RERUN_NS))
    reason = f"met {SYSTEM_CALLS} system calls in a row"
    return Strike("not_activated", reason, passed_over=SYSTEM_CALLS), Maps("")


def _at_the_mark(tracees: Tracees, thread: Thread, limit_s: float) -> bool:
    """Let everybody run until the target stands at the beginning of the call."""

    def look() -> bool | None:
        tracees.service()
        if thread.tid not in tracees.threads:
            return False
        return True if thread.report is not None and thread.report.kind == "gate" else None

    return bool(wait_until(look, limit_s))


def _missed(
    end: Literal["finished", "gone", "late"], system_calls: int, spent_ns: int, wait_ns: int, limit_s: float
) -> Strike:
    """What it means that the trap did not come."""
    if end == "gone":
        return Strike("failed", "the target died before the fault")
    if end == "late":
        return Strike("failed", f"neither the moment nor the call's end within {limit_s:g} s")
    if system_calls:
        return Strike("not_activated", "the call ended in a system call", passed_over=system_calls)
    return Strike(
        "not_reached", f"the call ended after {spent_ns} ns of thread time, before {wait_ns} ns of it"
    )


def _jitter(tracees: Tracees, thread: Thread, target: Process, steps: int) -> None:
    """Step on, but into no system call.

    :raises TargetError: if the target does not come through.
    """
    for _ in range(steps):
        registers, instruction = stand(thread, target)
        if registers.in_system_call or not instruction.steppable:
            return
        step(tracees, thread, instruction)


def _record(call: Call, fault: FaultSpec, tracees: Tracees, found: Strike, maps: Maps) -> InjectionRecord:
    record = InjectionRecord(
        status=found.status,
        mode="cpu_time",
        node=call.target.name,
        kernel=fault.target,
        invocation=fault.trigger.invocation if fault.trigger is not None else 0,
        model=fault.model,
        scope=fault.scope,
        pid=call.target.pid,
        tid=call.target.tid,
        virtual_time_ns=call.virtual_time_ns,
        pause_us=tracees.pause_us,
        threads_stopped=tracees.threads_stopped,
    ).model_copy(update=found.described())
    if found.instruction is None:
        return record
    where = place(call.target.pid, maps, found.instruction.address)
    return record.model_copy(
        update={
            "module": where.module,
            "build_id": where.build_id,
            "offset": where.offset,
            "symbol": where.symbol,
        }
    )
