"""Probes of a program in a stage's place: the injection point is in a call of a function of its main thread.

Its probes are processes of the same program that were told all that it was told (``services/foreign``).
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from injector.faults.stopped_thread import registers_of
from injector.flight.probe import LIMIT_S
from injector.flight.traced_site import MOST_STEPS, approach
from injector.isa.host import decode
from injector.isa.instruction import DecodeError
from injector.tracing.perf_events import Breakpoint, ThreadTimer, await_trap
from injector.tracing.process import CodeError, IdentityError, Process, ProcessIdentity
from injector.tracing.symbols import function_at
from injector.tracing.tracee import Tracee
from injector.tracing.tracees import TraceeGroup
from services.bus.announce import Announcement, start_ticks
from services.models.faults.specification import Trigger
from services.models.mission import MissionSpec
from services.system.process_stat import process_stat

_FOR_EVER_NS = 10**15


def programs(spec: MissionSpec) -> dict[str, tuple[int, int]]:
    """Device and inode of what a mission runs in the place of stages, by stage."""
    found: dict[str, tuple[int, int]] = {}
    for stage, own in spec.stack.stages.items() if spec.stack is not None else ():
        file = Path(own.command[0]).stat()
        found[stage] = file.st_dev, file.st_ino
    return found


def alike(program: Announcement, pid: int) -> Announcement:
    """The announcement of another process of the same program, started by the same node.

    :raises IdentityError: if it was not.
    """
    try:
        same = process_stat(pid).parent == process_stat(program.pid).parent
        claim = replace(program, pid=pid, tid=pid, start_ticks=start_ticks(pid))
    except OSError as error:
        message = f"process {pid} is gone"
        raise IdentityError(message) from error
    if not same:
        message = f"process {pid} was not started by the node of {program.name}"
        raise IdentityError(message)
    return claim


def entry_of(program: Announcement, function: str) -> int:
    """Where a function of a program begins.

    :raises SymbolError: if there is none of that name.
    """
    with Process(ProcessIdentity.announced(program)) as process:
        return function_at(process.pid, process.maps(), function)[0]


@dataclass(frozen=True, slots=True)
class StageProbe:
    """A process of the program that stands behind the first instruction of the call."""

    tracees: TraceeGroup
    thread: Tracee
    process: Process
    returns_to: int

    def trace(self) -> tuple[list[int], bool]:
        """Execute up to ``MOST_STEPS`` instructions; where they lie, and whether the call ended meanwhile."""
        watchdog = threading.Timer(LIMIT_S, os.kill, (self.thread.pid, signal.SIGKILL))
        watchdog.start()
        try:
            addresses = self.tracees.trace(self.thread, MOST_STEPS, self.returns_to)
        finally:
            watchdog.cancel()
            watchdog.join()
        # One that was killed, or was sent a signal, is no call that ended.
        stands = self.thread.report is not None and self.thread.report.kind == "step"
        return addresses, stands and len(addresses) < MOST_STEPS

    def run(self) -> int:
        """Run to the end of the call; the thread time that it took, ns."""
        with ThreadTimer(self.thread, _FOR_EVER_NS) as timer, Breakpoint(self.thread, self.returns_to, 1):
            self.tracees.resume(self.thread)
            await_trap(self.tracees, self.thread, lambda: False, LIMIT_S)
            return timer.spent_ns


@contextmanager
def at_the_function(program: Announcement, function: str, go: Callable[[], None]) -> Iterator[StageProbe]:
    """A process of the program at the beginning of the call, once ``go`` has it told; gone afterwards.

    :raises IdentityError, SymbolError: if it is not what it should be, or has no such function.
    :raises NeverCalledError: if the function is not called.
    """
    with Process(ProcessIdentity.announced(program)) as process, TraceeGroup() as tracees:
        try:
            tracees.seize([process.pid])
            process.verify()
            thread = tracees.threads[process.pid]
            entry = function_at(process.pid, process.maps(), function)[0]
            with Breakpoint(thread, entry, 1):
                go()
                end = await_trap(tracees, thread, lambda: False, LIMIT_S)
            if end != "trapped":
                message = f"{program.name} did not call {function} within {LIMIT_S:g} s: {end}"
                raise NeverCalledError(message)
            returns_to = process.read_memory(registers_of(thread).stack_pointer, 8)
            tracees.step(thread)
            yield StageProbe(tracees, thread, process, int.from_bytes(returns_to, "little"))
        finally:
            with suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGKILL)


def _code(process: Process, address: int) -> str:
    """The bytes of an instruction, hexadecimal; empty if they are none."""
    try:
        return decode(process.read_code(address), address).code.hex()
    except (CodeError, DecodeError):
        return ""


class NeverCalledError(Exception):
    """The program does not call the function in the step in which the fault is to be injected."""


def draw_site_in_function(
    probes: Callable[[], AbstractContextManager[StageProbe]], trigger: Trigger, draw: np.random.Generator
) -> Trigger:
    """Draw the instruction of the call into which the fault is injected.

    *exact*: uniform over the call's instructions behind the first, if there are at most ``MOST_STEPS``. Else
    a moment of its thread time.
    """
    with probes() as probe:
        addresses, ended = probe.trace()
        if ended and addresses:
            step = int(draw.integers(len(addresses)))
            # If the probe took another path than the program, other code is there and nothing is injected.
            seen = {"step": step + 1, "code": _code(probe.process, addresses[step])}
            site = approach(probe.process, addresses, step).model_copy(update=seen)
            return trigger.model_copy(update={"site": site})
    with probes() as probe:
        took_ns = probe.run()
    return trigger.model_copy(update={"cpu_ns": int(draw.random() * took_ns)})
