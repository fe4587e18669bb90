"""One injection from beginning to end: everybody is stopped, one is corrupted, all go on untraced."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from injector.elf import locate, place
from injector.freeze import Thread, Tracees
from injector.inject import Strike, TargetError, stand, step, strike
from injector.process import Identity, IdentityError, Maps, Process, VanishedError
from injector.ptrace import GoneError, wait_until
from injector.site import Seen, look
from injector.trigger import Breakpoint, ThreadTimer, await_trap
from services.bus.announce import Announcement
from services.bus.mission import FaultSpec, Site
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
            thread = _seize(tracees, target, bystanders, call.target.tid)
            way = _Way(tracees, thread, target, call, fault, draw, limit_s)
            try:
                found = way.to_the_site(trigger.site) if trigger.site is not None else way.by_time()
            except GoneError:
                found = Strike("failed", "the target died before the fault")
            except TargetError as error:
                found = Strike("failed", f"before the fault: {error}")
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


@dataclass
class _Way:
    """From the gate to the fault; ``maps`` are the target's at that moment, as a crash would take them away."""

    tracees: Tracees
    thread: Thread
    target: Process
    call: Call
    fault: FaultSpec
    draw: np.random.Generator
    limit_s: float
    maps: Maps = field(default_factory=lambda: Maps(""))
    seen: Seen | None = None

    def to_the_site(self, site: Site) -> Strike:
        """Go to the place that a site names, see that it is the same, strike."""
        self.call.armed()
        if self.call.marked and not self._at_the_mark():
            return Strike("failed", "the target never began the call")
        self.tracees.quieten(self.thread)
        if site.hit:
            address = locate(self.target.pid, self.target.maps(), site.module, site.build_id, site.offset)
            if address is None:
                return Strike("diverged", f"no such code is loaded: {site.module} {site.build_id}")
            with Breakpoint(self.thread, address, site.hit) as passes:
                self.tracees.resume(self.thread)
                end = self._await()
                hits = passes.hits
            if end == "finished":
                return Strike("not_reached", f"the call ended after {hits} passes, before the {site.hit}th")
            if end != "trapped":
                return _missed(end, self.limit_s)
        for taken in range(site.steps):
            end = self.tracees.step(self.thread)
            if end == "ended":
                return Strike("not_reached", f"the call ended {taken} steps on the way of {site.steps}")
            if end != "stepped":
                return Strike("failed", f"before the fault: the thread {end}")
        self.maps = self.target.maps()
        self.seen = look(self.thread, self.target, self.maps)
        for what, found, expected in (
            ("instruction", self.seen.code, site.code),
            ("registers", self.seen.registers, site.registers),
        ):
            if expected and found != expected:
                return Strike("diverged", f"other {what} at the site: {found}, not {expected}")
        return self._strike() or Strike("not_activated", "the site is a system call")

    def by_time(self) -> Strike:
        """Wait for the moment, and strike."""
        trigger = self.fault.trigger
        wait_ns = (trigger.cpu_ns if trigger is not None else None) or 0
        self.call.armed()
        if self.call.marked and not self._at_the_mark():
            return Strike("failed", "the target never began the call")
        for system_calls in range(SYSTEM_CALLS):
            with ThreadTimer(self.thread, wait_ns) as timer:
                self.tracees.resume_all()
                end = self._await(timer.insist)
                spent_ns = timer.spent_ns
            if end == "finished" and system_calls:
                return Strike("not_activated", "the call ended in a system call", passed_over=system_calls)
            if end == "finished":
                return Strike(
                    "not_reached",
                    f"the call ended after {spent_ns} ns of thread time, before {wait_ns} ns of it",
                )
            if end != "trapped":
                return _missed(end, self.limit_s)
            self.maps = self.target.maps()
            _jitter(self.tracees, self.thread, self.target, int(self.draw.integers(JITTER_STEPS + 1)))
            found = self._strike()
            if found is not None:
                return replace(found, passed_over=found.passed_over + system_calls)
            wait_ns = int(self.draw.integers(RERUN_NS))
        reason = f"met {SYSTEM_CALLS} system calls in a row"
        return Strike("not_activated", reason, passed_over=SYSTEM_CALLS)

    def _strike(self) -> Strike | None:
        self.tracees.stop_all()
        return strike(self.tracees, self.thread, self.target, self.fault, self.draw)

    def _at_the_mark(self) -> bool:
        """Let everybody run until the target stands at the beginning of the call."""

        def there() -> bool | None:
            self.tracees.service()
            if self.thread.tid not in self.tracees.threads:
                return False
            return True if self.thread.report is not None and self.thread.report.kind == "gate" else None

        return bool(wait_until(there, self.limit_s))

    def _await(
        self, insist: Callable[[], None] = lambda: None
    ) -> Literal["trapped", "finished", "gone", "late"]:
        return await_trap(self.tracees, self.thread, self.call.finished, self.limit_s, insist)


def _missed(end: Literal["gone", "late"], limit_s: float) -> Strike:
    """What it means that neither the moment nor the call's end came."""
    if end == "gone":
        return Strike("failed", "the target died before the fault")
    return Strike("failed", f"neither the moment nor the call's end within {limit_s:g} s")


def _jitter(tracees: Tracees, thread: Thread, target: Process, steps: int) -> None:
    """Step on, but into no system call.

    :raises TargetError: if the target does not come through.
    """
    for _ in range(steps):
        registers, instruction = stand(thread, target)
        if registers.in_system_call or not instruction.steppable:
            return
        step(tracees, thread, instruction)


def _record(way: _Way, found: Strike) -> InjectionRecord:
    call, fault, tracees, maps = way.call, way.fault, way.tracees, way.maps
    trigger = fault.trigger
    assert trigger is not None  # noqa: S101 - checked where the injection began
    if trigger.site is not None and way.seen is not None and found.status != "diverged":
        seen = {"code": way.seen.code, "registers": way.seen.registers}
        trigger = trigger.model_copy(update={"site": trigger.site.model_copy(update=seen)})
    record = InjectionRecord(
        status=found.status,
        reason=found.reason,
        mode=trigger.site.rung if trigger.site is not None else "cpu_time",
        trigger=trigger,
        node=call.target.name,
        kernel=fault.target,
        invocation=trigger.invocation or 0,
        pid=call.target.pid,
        tid=call.target.tid,
        virtual_time_ns=call.virtual_time_ns,
        pause_us=tracees.pause_us,
        threads_stopped=tracees.threads_stopped,
        resampled=found.passed_over,
    )
    if found.instruction is not None:
        where = place(call.target.pid, maps, found.instruction.address)
        record = record.model_copy(
            update={
                "module": where.module,
                "build_id": where.build_id,
                "offset": where.offset,
                "symbol": where.symbol,
                "instruction_bytes": found.instruction.code.hex(),
                "instruction": found.instruction.text,
            }
        )
    if found.candidate is None:
        return record
    width = found.candidate.width_bits
    return record.model_copy(
        update={
            "operand": found.candidate.role,
            "register_name": found.candidate.register,
            "width_bits": width,
            "bits": [found.bit],
            **{
                name: f"{value:0{width // 4}x}"
                for name, value in (
                    ("before", found.before),
                    ("after", found.after),
                    ("read_back", found.read_back),
                )
            },
        }
    )
