"""Approach in a node of a flight: from the gate to the injection point that the trigger names."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from injector.faults.apply import apply_fault
from injector.faults.approach import Approach, MissedError
from injector.faults.stopped_thread import InjectionResult, stand, step
from injector.flight.fingerprint import Fingerprint, Pointers, fingerprint_of
from injector.tracing.compiled_functions import CompiledFunctions
from injector.tracing.elf import locate
from injector.tracing.perf_events import Breakpoint, ThreadTimer, await_trap
from injector.tracing.process import MemoryMap, Process, sleeps
from injector.tracing.tracee import Tracee
from injector.tracing.tracees import TraceeGroup
from injector.tracing.waiting import wait_until
from services.bus.announce import Announcement
from services.models.faults.specification import FaultSpec, Site, Waypoint

RERUN_NS = 100_000
"""Longest thread time from a system call to the next attempt."""

ALONE_SLEEPS = 50
"""Looks, a millisecond apart, at which a thread that runs alone sleeps before the others go on, too."""


@dataclass(frozen=True, slots=True)
class KernelCall:
    """The call of a kernel that a fault is aimed at, while it is under way.

    ``armed`` is called once, when everybody is traced. A target that is ``marked`` tells by signals to
    itself where the call begins and ends (``Node.kernel``), and its thread time counts from the first;
    else it counts from ``armed`` on, and ``finished``, asked about every millisecond, tells the end. If there
    is an ``entry``, the call is one of the function there, and begins behind its first instruction.
    ``leave_out`` is told how long everybody stood, in nanoseconds, just before they go on. ``compiled`` are
    the functions of numba that the target has in common with us, unless it is somebody's program.
    """

    target: Announcement
    virtual_time_ns: int
    armed: Callable[[], None]
    finished: Callable[[], bool] = lambda: False
    marked: bool = False
    entry: int = 0
    leave_out: Callable[[int], object] = lambda _pause_ns: None
    compiled: CompiledFunctions | None = None


@dataclass
class NodeApproach(Approach):
    """Brings a node's thread to the injection point; see :class:`injector.faults.approach.Approach`.

    ``maps``, ``fingerprint`` and ``pointers`` are of the moment of the fault: a crash takes them away.
    """

    DIED = "the target died before the fault"

    tracees: TraceeGroup
    thread: Tracee
    target: Process
    call: KernelCall
    fault: FaultSpec
    draw: np.random.Generator
    limit_s: float
    maps: MemoryMap = field(default_factory=lambda: MemoryMap(""))
    fingerprint: Fingerprint | None = None
    pointers: Pointers | None = None
    _slept: int = 0

    def _run(self) -> InjectionResult:
        trigger = self.fault.trigger
        assert trigger is not None  # noqa: S101 - checked where the injection began
        self._to_the_mark()
        if trigger.site is not None:
            return self._at(trigger.site)
        return self._after(trigger.cpu_ns or 0)

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
            raise TimeoutError(f"the target did not begin the call within {self.limit_s:g} s")

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

    def _at(self, site: Site) -> InjectionResult:
        """Go to the place that a site names, check that it is the same, and inject.

        It is the same if the instruction is and reads the same numbers; what its pointers point into may lie
        elsewhere in memory. The target's other threads stand meanwhile: nothing that they do can change what
        it executes.
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
        self.fingerprint, self.pointers = fingerprint_of(self.thread, self.target, self.maps)
        self._check(self.fingerprint, site)
        return self._inject() or InjectionResult("not_activated", "the site is a system call")

    @staticmethod
    def _check(found: Fingerprint, site: Site) -> None:
        if site.code and found.code != site.code:
            raise MissedError("diverged", f"other instruction at the site: {found.code}, not {site.code}")
        if site.registers and found.registers != site.registers and found.relative != site.relative:
            raise MissedError(
                "diverged", f"other registers at the site: {found.registers}, not {site.registers}"
            )

    def _pass_through(self, site: Site) -> None:
        if site.way is None:
            self._to_a_pass(site, site.hit, 0)
            return
        self._to_a_pass(site.way, site.way.hit, 0)
        self._to_a_pass(site, site.way.rest, site.hit - site.way.rest)

    def _to_a_pass(self, through: Site | Waypoint, hit: int, before: int) -> None:
        """Run to a pass through an address, the ``hit``-th from here; so many were ``before``."""
        module, build_id, offset = through.module, through.build_id, through.offset
        maps = self.target.maps()
        address = locate(self.target.pid, maps, module, build_id, offset, self.call.compiled)
        if address is None:
            code = f"{module} {build_id}".strip() or f"{offset:#x}"
            raise MissedError("diverged", f"no such code is loaded: {code}")
        with Breakpoint(self.thread, address, hit) as passes:
            self.tracees.resume(self.thread)
            end = self._await(self._wake_the_others)
            hits = passes.hits
        if end == "finished":
            reason = f"the call ended after {before + hits} of {before + hit} passes"
            raise MissedError("not_reached", reason)
        if end != "trapped":
            raise self._lost(end)

    def _wake_the_others(self) -> None:
        """Let all run on if the target waits for one of them."""
        self._slept = self._slept + 1 if sleeps(self.thread.tid) else 0
        if self._slept == ALONE_SLEEPS:
            self.tracees.resume_all()

    # -- to a moment -------------------------------------------------------------------------------

    def _after(self, wait_ns: int) -> InjectionResult:
        """Wait for a moment of thread time, and inject; again a little later if it is in a system call."""

        def attempt(met: int) -> InjectionResult | None:
            delay_ns = int(self.draw.integers(RERUN_NS)) if met else wait_ns
            with ThreadTimer(self.thread, delay_ns) as timer:
                self.tracees.resume_all()
                end = self._await(timer.insist)
                spent_ns = timer.spent_ns
            if end == "finished" and met:
                return InjectionResult("not_activated", "the call ended in a system call")
            if end == "finished":
                ended = f"the call ended after {spent_ns} ns of thread time"
                raise MissedError("not_reached", f"{ended}, before {wait_ns} ns of it")
            if end != "trapped":
                raise self._lost(end)
            self.maps = self.target.maps()
            self._jitter(self.thread, self.target, self._step)
            return self._inject()

        return self._past_system_calls(attempt)

    def _step(self, thread: Tracee) -> None:
        step(self.tracees, thread, stand(thread, self.target)[1])

    # -- at the injection point --------------------------------------------------------------------

    def _inject(self) -> InjectionResult | None:
        return apply_fault(
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
        """What to raise where the thread did not come to the place.

        :raises TimeoutError: if it neither came nor ended: no result of the fault, but our failure.
        """
        if end == "gone":
            return MissedError("failed", "the target died before the fault")
        raise TimeoutError(f"neither the moment nor the call's end came within {self.limit_s:g} s")
