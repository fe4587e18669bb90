"""From the gate to the fault: the target is brought to the instruction that is to be struck."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from injector.elf import locate
from injector.freeze import Tracees
from injector.inject import Strike, TargetError, stand, step
from injector.process import Maps, Process, sleeps
from injector.ptrace import GoneError, wait_until
from injector.site import Seen, look
from injector.strike import strike
from injector.thread import Thread
from injector.trigger import Breakpoint, ThreadTimer, await_trap
from services.bus.announce import Announcement
from services.bus.mission import FaultSpec, Site

JITTER_STEPS = 64
"""Most single steps after the trap: a trap strikes at an interrupt, and not at every instruction alike."""

SYSTEM_CALLS = 16
"""System calls met at the drawn moment that are let pass before we give up."""

RERUN_NS = 100_000
"""Longest thread time from a system call to the next attempt."""

ALONE_SLEEPS = 50
"""Looks, a millisecond apart, at which a thread that runs alone sleeps before the others go on, too."""


@dataclass(frozen=True, slots=True)
class Call:
    """The call of a kernel that a fault is aimed at, while it is under way.

    ``armed`` is called once, when everybody is traced. A target that is ``marked`` tells by signals to
    itself where the call begins and ends (``Node.kernel``), and its thread time counts from the first;
    else it counts from ``armed`` on, and ``finished``, asked about every millisecond, tells the end. If there
    is an ``entry``, the call is one of the function there, and begins behind its first instruction.
    ``leave_out`` is told how long everybody stood, in nanoseconds, just before they go on.
    """

    target: Announcement
    virtual_time_ns: int
    armed: Callable[[], None]
    finished: Callable[[], bool] = lambda: False
    marked: bool = False
    entry: int = 0
    leave_out: Callable[[int], object] = lambda _pause_ns: None


class MissedError(Exception):
    """The fault cannot be injected as it was asked for."""

    def __init__(
        self, status: Literal["not_activated", "not_reached", "diverged", "failed"], reason: str
    ) -> None:
        super().__init__(reason)
        self.strike = Strike(status, reason)


@dataclass
class Way:
    """One way to one fault; ``maps`` and ``seen`` are of its moment, as a crash would take them away."""

    tracees: Tracees
    thread: Thread
    target: Process
    call: Call
    fault: FaultSpec
    draw: np.random.Generator
    limit_s: float
    maps: Maps = field(default_factory=lambda: Maps(""))
    seen: Seen | None = None
    _slept: int = 0

    def to_the_fault(self) -> Strike:
        """Go all the way and strike; what came of it."""
        trigger = self.fault.trigger
        assert trigger is not None  # noqa: S101 - checked where the injection began
        try:
            self._to_the_mark()
            if trigger.site is not None:
                return self._at(trigger.site)
            return self._after(trigger.cpu_ns or 0)
        except MissedError as error:
            return error.strike
        except GoneError:
            return Strike("failed", "the target died before the fault")
        except TargetError as error:
            return Strike("failed", f"before the fault: {error}")

    def _to_the_mark(self) -> None:
        """Let everybody run until the target stands at the beginning of the call."""
        if self.call.entry:
            self._to_the_entry()
            return
        self.call.armed()

        def there() -> bool | None:
            self.tracees.service()
            if self.thread.tid not in self.tracees.threads:
                return False
            return True if self.thread.report is not None and self.thread.report.kind == "gate" else None

        if self.call.marked and not wait_until(there, self.limit_s):
            raise MissedError("failed", "the target never began the call")

    def _to_the_entry(self) -> None:
        with Breakpoint(self.thread, self.call.entry, 1):
            self.call.armed()
            end = self._await(lambda: None)
        if end == "finished":
            raise MissedError("not_reached", "the function was not called in that step")
        if end != "trapped":
            raise self._lost(end)
        if self.tracees.step(self.thread) != "stepped":
            raise MissedError("failed", "before the fault: the function's first instruction was its last")

    # -- to a site ---------------------------------------------------------------------------------

    def _at(self, site: Site) -> Strike:
        """Go to the place that a site names, see that it is the same, strike.

        The target's other threads stand meanwhile: nothing that they do can lead it another way.
        """
        self.tracees.quieten(self.thread)
        if site.hit:
            self._pass_through(site)
        for taken in range(site.steps):
            end = self.tracees.step(self.thread)
            if end == "ended":
                raise MissedError("not_reached", f"the call ended {taken} steps on the way of {site.steps}")
            if end != "stepped":
                raise MissedError("failed", f"before the fault: the thread {end}")
        self.maps = self.target.maps()
        self.seen = look(self.thread, self.target)
        for what, found, expected in (
            ("instruction", self.seen.code, site.code),
            ("registers", self.seen.registers, site.registers),
        ):
            if expected and found != expected:
                raise MissedError("diverged", f"other {what} at the site: {found}, not {expected}")
        return self._strike() or Strike("not_activated", "the site is a system call")

    def _pass_through(self, site: Site) -> None:
        address = locate(self.target.pid, self.target.maps(), site.module, site.build_id, site.offset)
        if address is None:
            code = f"{site.module} {site.build_id}".strip() or f"{site.offset:#x}"
            raise MissedError("diverged", f"no such code is loaded: {code}")
        with Breakpoint(self.thread, address, site.hit) as passes:
            self.tracees.resume(self.thread)
            end = self._await(self._wake_the_others)
            hits = passes.hits
        if end == "finished":
            raise MissedError("not_reached", f"the call ended after {hits} of {site.hit} passes")
        if end != "trapped":
            raise self._lost(end)

    def _wake_the_others(self) -> None:
        """Let all run on if the target waits for one of them."""
        self._slept = self._slept + 1 if sleeps(self.thread.tid) else 0
        if self._slept == ALONE_SLEEPS:
            self.tracees.resume_all()

    # -- to a moment -------------------------------------------------------------------------------

    def _after(self, wait_ns: int) -> Strike:
        """Wait for a moment of thread time, and strike; again a little later if it is in a system call."""
        for system_calls in range(SYSTEM_CALLS):
            with ThreadTimer(self.thread, wait_ns) as timer:
                self.tracees.resume_all()
                end = self._await(timer.insist)
                spent_ns = timer.spent_ns
            if end == "finished" and system_calls:
                return Strike("not_activated", "the call ended in a system call", passed_over=system_calls)
            if end == "finished":
                ended = f"the call ended after {spent_ns} ns of thread time"
                raise MissedError("not_reached", f"{ended}, before {wait_ns} ns of it")
            if end != "trapped":
                raise self._lost(end)
            self.maps = self.target.maps()
            self._jitter(int(self.draw.integers(JITTER_STEPS + 1)))
            found = self._strike()
            if found is not None:
                return replace(found, passed_over=found.passed_over + system_calls)
            wait_ns = int(self.draw.integers(RERUN_NS))
        reason = f"met {SYSTEM_CALLS} system calls in a row"
        return Strike("not_activated", reason, passed_over=SYSTEM_CALLS)

    def _jitter(self, steps: int) -> None:
        """Step on, but into no system call."""
        for _ in range(steps):
            registers, instruction = stand(self.thread, self.target)
            if registers.in_system_call or not instruction.steppable:
                return
            step(self.tracees, self.thread, instruction)

    # -- either way --------------------------------------------------------------------------------

    def _strike(self) -> Strike | None:
        return strike(
            self.tracees,
            self.thread,
            self.target,
            self.fault,
            self.draw,
            stop=self.tracees.stop_all,
            go=self.tracees.detach_all,
        )

    def _await(self, insist: Callable[[], None]) -> Literal["trapped", "finished", "gone", "late"]:
        return await_trap(self.tracees, self.thread, self.call.finished, self.limit_s, insist)

    def _lost(self, end: Literal["gone", "late"]) -> MissedError:
        if end == "gone":
            return MissedError("failed", "the target died before the fault")
        return MissedError("failed", f"neither the moment nor the call's end within {self.limit_s:g} s")
