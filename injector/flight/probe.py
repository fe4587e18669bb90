"""Finding one dynamic instruction of a call before the call is made, by running copies of it ahead.

A probe (:mod:`services.runtime.probe_gate`) stands at the beginning of the call. It costs wall time only.
"""

from __future__ import annotations

import os
import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from injector.isa.host import decode
from injector.isa.instruction import DecodeError
from injector.tracing.elf import place
from injector.tracing.perf_events import Breakpoint, ThreadTimer, await_trap
from injector.tracing.process import CodeError, Process, ProcessIdentity
from injector.tracing.ptrace import wait_until
from injector.tracing.tracee import Tracee
from injector.tracing.tracees import TraceeGroup
from services.bus.announce import Announcement
from services.models.mission import Site, Trigger
from services.runtime.kernel_timer import GATE_SIGNAL

SHORT_NS = 1_000_000
"""Longest thread time of a call of which so many single steps are tried; a longer one surely has too many."""

MOST_STEPS = 150_000
"""Instructions after which a call counts as too long for the precision `exact`: some 3 s of wall time."""

SLOW_NS, FEW_STEPS = 8_000_000, 25_000
"""Up to this time fewer steps are tried: a copy takes it for a few thousand instructions on a slow machine.

Most of its time goes by while it is given its memory, a page at a time: 0.2 to 1 ms in a call of 20 us.
"""

WINDOW = 2_000
"""Most single steps from a breakpoint to the site."""

MOST_HITS = 100_000
"""Passes through an address beyond which another one is drawn: a second of wall time."""

DRAWS = 4
"""Places that are drawn before thread time decides where to inject."""

STEPS_A_HIT = 0.4
"""What a pass through a breakpoint costs, in single steps."""

LIMIT_S = 20.0
"""Wall time after which a probe is given up."""


@dataclass(frozen=True, slots=True)
class ProbeRun:
    """A copy of the target that stands at the beginning of the call."""

    tracees: TraceeGroup
    thread: Tracee
    process: Process

    def run(self) -> int:
        """Run to the end of the call; the thread time that it took, ns."""
        with ThreadTimer(self.thread, 10**15) as timer:
            self.tracees.resume(self.thread)
            self._await()
            return timer.spent_ns

    def run_for(self, cpu_ns: int) -> bool:
        """Run for some thread time; whether the call goes on then."""
        with ThreadTimer(self.thread, cpu_ns) as timer:
            self.tracees.resume(self.thread)
            return self._await(insist=timer.insist) == "trapped"

    def count(self, address: int) -> int:
        """Run to the end of the call; how often it passes an address, 0 if more often than we can afford."""
        with Breakpoint(self.thread, address) as passes:
            self.tracees.resume(self.thread)
            end = self._await(lambda: passes.hits > MOST_HITS)
            return passes.hits if end == "finished" and passes.hits <= MOST_HITS else 0

    def trace(self, most: int) -> tuple[list[int], bool]:
        """Execute up to ``most`` instructions; their addresses, and whether the call ended meanwhile."""
        watchdog = threading.Timer(LIMIT_S, os.kill, (self.thread.pid, signal.SIGKILL))
        watchdog.start()
        try:
            addresses = self.tracees.trace(self.thread, most)
        finally:
            watchdog.cancel()
            watchdog.join()
        # One that was killed is no call that ended.
        return addresses, self.thread.report is not None and self.thread.report.kind == "gate"

    def _await(
        self, finished: Callable[[], bool] = lambda: False, insist: Callable[[], None] = lambda: None
    ) -> Literal["trapped", "finished", "gone", "late"]:
        return await_trap(self.tracees, self.thread, finished, LIMIT_S, insist)


@contextmanager
def sent_ahead(target: Announcement, send: Callable[[], None]) -> Iterator[ProbeRun]:
    """A probe that ``target`` forks once it is told to, at the beginning of its call; gone afterwards.

    :raises IdentityError: if the target is not what it was announced as, or gone.
    :raises ProbeError: if none comes.
    """
    with Process(ProcessIdentity.announced(target)) as node, TraceeGroup(GATE_SIGNAL, forks=True) as tracees:
        tracees.seize([node.pid])
        node.verify()
        send()

        def forked() -> Tracee | None:
            tracees.service()
            new = [one for one in tracees.threads.values() if one.pid != node.pid]
            return new[0] if new and new[0].report is not None and new[0].report.kind == "gate" else None

        thread = wait_until(forked, LIMIT_S)
        if thread is None:
            message = f"process {node.pid} sent no probe within {LIMIT_S:g} s"
            raise ProbeError(message)
        with Process(ProcessIdentity.of(thread.pid)) as process, _on_one_processor(thread.pid):
            try:
                yield ProbeRun(tracees, thread, process)
            finally:
                with suppress(ProcessLookupError):
                    os.kill(thread.pid, signal.SIGKILL)


@contextmanager
def _on_one_processor(pid: int) -> Iterator[None]:
    """Hold ourselves and a process on the processor that we are on: stepping is three times as fast."""
    allowed = os.sched_getaffinity(0)
    one = {min(allowed)}
    try:
        os.sched_setaffinity(pid, one)
        os.sched_setaffinity(0, one)
        yield
    finally:
        os.sched_setaffinity(0, allowed)


class ProbeError(Exception):
    """The target sends no probe, or a probe was killed."""


Scope = Callable[[Process], Callable[[int], bool]]
"""Tells for a process whether the instruction at an address comes into question."""


def _everywhere(_: Process) -> Callable[[int], bool]:
    return lambda _: True


def draw_site(
    probes: Callable[[], AbstractContextManager[ProbeRun]],
    trigger: Trigger,
    draw: np.random.Generator,
    scope: Scope = _everywhere,
) -> Trigger:
    """Draw the site of the fault in a call; each probe that ``probes`` yields stands at its beginning.

    *exact*: uniform over the call's instructions within the scope, if there are not too many. *occurrence*: a
    place by thread time, the last in the scope within a window from there, then one of the passes through it,
    all alike. If its places are too busy, or the scope is not met there: thread time.
    """
    with probes() as probe:
        took_ns = probe.run()
    if took_ns <= SLOW_NS:
        with probes() as probe:
            trace, ended = probe.trace(MOST_STEPS if took_ns <= SHORT_NS else FEW_STEPS)
            inside = scope(probe.process)
            among = [at for at, address in enumerate(trace) if inside(address)]
            if ended and among:
                step = among[int(draw.integers(len(among)))]
                site = approach(probe.process, trace, step).model_copy(update={"step": step})
                return trigger.model_copy(update={"site": site})
    for _ in range(DRAWS):
        with probes() as probe:
            if not probe.run_for(int(draw.random() * took_ns)):
                continue
            trace, _ = probe.trace(WINDOW)
            inside = scope(probe.process)
            while trace and not inside(trace[-1]):
                trace.pop()
            if not trace:
                continue
            begin = rarest(probe.process, trace, inside)
            there = place(probe.process.pid, probe.process.maps(), trace[begin])
        with probes() as probe:
            hits = probe.count(trace[begin])
        if hits:
            site = Site(
                precision="occurrence",
                module=there.module,
                build_id=there.build_id,
                offset=there.offset,
                hit=1 + int(draw.integers(hits)),
                steps=len(trace) - 1 - begin,
            )
            return trigger.model_copy(update={"site": site})
    return trigger.model_copy(update={"cpu_ns": int(draw.random() * took_ns)})


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


def rarest(process: Process, trace: Sequence[int], inside: Callable[[int], bool] = lambda _: True) -> int:
    """Index of the last pass through the address within the scope that a trace passes least often.

    The trace ends in the scope.
    """
    passes = Counter(trace)
    usable = _breakable(process, trace)
    return min(
        (at for at in range(len(trace)) if usable[at] and inside(trace[at])),
        key=lambda at: (passes[trace[at]], -at),
        default=len(trace) - 1,
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
