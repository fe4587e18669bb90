"""One injection from beginning to end: everybody is stopped, one is corrupted, all go on untraced."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack, suppress

import numpy as np

from injector.elf import place
from injector.freeze import Tracees
from injector.inject import Strike
from injector.process import Identity, IdentityError, Process, VanishedError
from injector.thread import Thread
from injector.way import Call, Way
from services.bus.announce import Announcement
from services.bus.mission import FaultSpec
from services.bus.node import GATE_SIGNAL
from services.bus.outcome import InjectionRecord


def inject(
    call: Call,
    others: Sequence[Announcement],
    fault: FaultSpec,
    draw: np.random.Generator,
    limit_s: float = 60.0,
) -> InjectionRecord:
    """Inject ``fault`` at its trigger's site, or after ``cpu_ns`` of the target's thread time.

    All threads of the target and of ``others`` (the injector's own process is none of them) stand while
    the bit is flipped; processes of ``others`` that are gone meanwhile are left out. When this returns or
    raises, nobody is traced. ``draw`` decides on jitter, register and bit. ``limit_s`` is wall time.

    :raises IdentityError: if a process is not what it was announced as, or the target is gone.
    :raises NotPermittedError, TriggerError: if the kernel forbids tracing or timing.
    :raises FreezeError: if a thread cannot be stopped.
    :raises ValueError: if the fault has no trigger that says where.
    """
    trigger = fault.trigger
    if trigger is None or (trigger.site is None and trigger.cpu_ns is None):
        raise ValueError(
            "a fault whose trigger names no place in the call cannot be injected: draw one first"
        )
    with ExitStack() as held:
        bystanders = []
        for one in others:
            with suppress(VanishedError):
                bystanders.append(held.enter_context(Process(Identity.announced(one))))
        target = held.enter_context(Process(Identity.announced(call.target)))
        with Tracees(GATE_SIGNAL) as tracees:
            tracees.leave_out = call.leave_out
            thread = _seize(tracees, target, bystanders, call.target.tid)
            way = Way(tracees, thread, target, call, fault, draw, limit_s)
            found = way.to_the_fault()
        return _record(way, found)


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


def _record(way: Way, found: Strike) -> InjectionRecord:
    call, fault, tracees, maps = way.call, way.fault, way.tracees, way.maps
    trigger = fault.trigger
    assert trigger is not None  # noqa: S101 - checked where the injection began
    if trigger.site is not None and way.seen is not None and found.status != "diverged":
        seen = {"code": way.seen.code, "registers": way.seen.registers}
        trigger = trigger.model_copy(update={"site": trigger.site.model_copy(update=seen)})
    record = InjectionRecord(
        status=found.status,
        mode=trigger.site.rung if trigger.site is not None else "cpu_time",
        trigger=trigger,
        node=call.target.name,
        kernel=fault.target,
        invocation=trigger.invocation or 0,
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
