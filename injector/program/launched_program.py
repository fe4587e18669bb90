"""A program that is launched and traced from its first instruction, with all that it starts."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

from injector.isa.x86_64_registers import X8664Registers, skipping_call
from injector.tracing import ptrace
from injector.tracing.process import Process, ProcessIdentity
from injector.tracing.ptrace import NT_PRSTATUS, GoneError, StopReport
from injector.tracing.tracee import Tracee
from injector.tracing.tracees import DEATH_LIMIT_S, TraceeGroup
from injector.tracing.waiting import wait_until

STACK_STRINGS = 1 << 14
"""Arguments and environment are filled up to a multiple of this, in bytes: so the stack begins alike."""

_PADDING = "ZENFI_PADDING"
_WORD = struct.Struct("<Q")
_AT_IGNORE, _AT_RANDOM, _AT_SYSINFO_EHDR = 1, 25, 33
_SET_SIZE = 512
_BEGIN_S = 20.0
_SLEEP_S = 0.05  # between two looks at a program that runs: a process of one thread misses no signal


class LaunchError(Exception):
    """A program could not be started or traced: one line."""


@dataclass(frozen=True, slots=True)
class Order:
    """What is to be launched. ``streams`` are path and flags of standard input, output and error."""

    executable: str
    arguments: Sequence[str]
    environment: Mapping[str, str]
    folder: str
    streams: Sequence[tuple[str, int]]
    largest_file: int = 1 << 40


@dataclass(frozen=True, slots=True)
class Ending:
    """How a program ended, as its parent sees it: ``status`` as of :func:`os.waitstatus_to_exitcode`."""

    status: int
    cpu_s: float


def padded(executable: str, arguments: Sequence[str], environment: Mapping[str, str]) -> dict[str, str]:
    """The environment, filled up so that the stack lies alike, however long what is on it."""
    kept = {name: value for name, value in sorted(environment.items()) if name != _PADDING}
    strings = [executable, *arguments, *(f"{name}={value}" for name, value in kept.items()), f"{_PADDING}="]
    size = sum(len(os.fsencode(one)) + 1 for one in strings)
    return kept | {_PADDING: "-" * (-size % STACK_STRINGS)}


class Launcher:
    """The process that launches programs, one at a time; it dies with us, and they with it."""

    def __init__(self, processor: int, writable: Path) -> None:
        """Start it; all that it launches has one ``processor`` and can change files in one folder only.

        ``protects`` says, once a program was launched, whether other files cannot be changed.
        """
        self.protects = False
        self._process = subprocess.Popen(  # noqa: S603 - ours
            [sys.executable, "-P", "-m", "injector.program.launcher", str(processor), str(writable)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
            start_new_session=True,
        )

    def launch(self, order: Order, *, exits: bool = False) -> LaunchedProgram:
        """Launch a program: it stands before its first instruction, traced; threads report their ``exits``.

        :raises LaunchError: if it cannot be executed or traced.
        """
        self.say(json.dumps(asdict(order)).encode() + b"\n")
        told = self.hear()
        self.protects = bool(told["protected"])
        return LaunchedProgram(self, int(told["pid"]), own_pids=bool(told["own_pids"]), exits=exits)

    def say(self, content: bytes) -> None:
        """Write to the launcher: an order, or the byte for which a program waits."""
        assert self._process.stdin is not None  # noqa: S101 - a pipe
        self._process.stdin.write(content)

    def hear(self) -> dict[str, Any]:
        """Wait for the next answer of the launcher.

        :raises LaunchError: if it has ended.
        """
        assert self._process.stdout is not None  # noqa: S101 - a pipe
        line = self._process.stdout.readline()
        if not line:
            message = f"the launcher of programs ended (status {self._process.wait()})"
            raise LaunchError(message)
        answer: dict[str, Any] = json.loads(line)
        return answer

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()


class LaunchedProgram(TraceeGroup):
    """A program and what it starts, traced until its end; ``process`` is the program itself.

    Random bytes that it asks the kernel for (getrandom(2)) are the same in each run, as are the keys of its
    stack; clocks are read by calls of the kernel. To be used within ``with``, which kills what is left.
    """

    def __init__(self, launcher: Launcher, pid: int, *, own_pids: bool, exits: bool) -> None:
        super().__init__(ours=True)
        self._exits, self._own_pids = exits, own_pids
        self.pid, self._launcher, self._drawn = pid, launcher, 0
        self._told: _Answer | None = None

    def __enter__(self) -> Self:
        """Trace the program up to its first instruction.

        :raises LaunchError: if it cannot be executed or traced.
        """
        super().__enter__()
        try:
            self._begin()
        except BaseException:
            self.__exit__()
            raise
        return self

    def _begin(self) -> None:
        try:
            ptrace.seize_launched(self.pid, exits=self._exits)
        except ptrace.PtraceError as error:
            raise LaunchError(str(error)) from error
        thread = self.threads[self.pid] = Tracee(self.pid, self.pid)
        self._launcher.say(b"x")
        begun = wait_until(lambda: self._begun(thread), _BEGIN_S)
        if not begun or thread.report is None or thread.report.kind != "program":
            raise LaunchError(self._end().problem or "the program did not begin")
        self.process = Process(ProcessIdentity.of(self.pid))
        ptrace.step(self.pid)  # out of the call that executed the program, before its first instruction
        self.await_one(thread)
        self._fix_keys(X8664Registers(self.pid).stack_pointer)

    def _begun(self, thread: Tracee) -> bool | None:
        report = self._look(thread)
        if report is None:
            return None
        if report.kind not in ("program", "gone"):
            self.resume(thread)
            return None
        return True

    def _end(self) -> _Answer:
        """What the launcher tells of the program's end; waits for it."""
        if self._told is None:
            told = self._launcher.hear()
            self._told = _Answer(Ending(int(told["status"]), float(told["cpu_s"])), str(told["problem"]))
        return self._told

    def _fix_keys(self, stack: int) -> None:
        mapping = self.process.maps().at(stack)
        assert mapping is not None  # noqa: S101 - a program has a stack
        content = self.process.read_memory(stack, mapping.end - stack)
        words = memoryview(content[: len(content) // 8 * 8]).cast("Q").tolist()
        auxiliary = words.index(0, words.index(0, 1) + 1) + 1
        for at in range(auxiliary, len(words) - 1, 2):
            if words[at] == 0:
                return
            if words[at] == _AT_RANDOM:
                self.process.write_memory(words[at + 1], _key(0, 16))
            if words[at] == _AT_SYSINFO_EHDR:
                self.process.write_memory(stack + 8 * at, _WORD.pack(_AT_IGNORE))

    @property
    def main(self) -> Tracee | None:
        """The program's first thread; None if it has ended."""
        return self.threads.get(self.pid)

    def resume(self, thread: Tracee) -> None:
        """Let a standing thread run; one that asks for random bytes gets the same in each run."""
        if thread.report is not None and thread.report.kind == "filtered":
            with suppress(GoneError):
                self.give_random_bytes(thread)
        super().resume(thread)

    def give_random_bytes(self, thread: Tracee) -> None:
        """Answer a thread that stands before getrandom(2)."""
        registers = X8664Registers(thread.tid)
        address, size = registers.get("rdi"), min(registers.get("rsi"), 256)
        own = ptrace.read_registers(thread.tid, NT_PRSTATUS, _SET_SIZE)
        # As of each process: which thread comes first, may be another one in each run.
        memory = os.open(f"/proc/{thread.pid}/mem", os.O_RDWR | os.O_CLOEXEC)
        try:
            os.pwrite(memory, _key(1 + self._drawn, size), address)
        except OSError:
            return  # the kernel tells the program that there is no memory
        finally:
            os.close(memory)
        self._drawn += 1
        ptrace.write_registers(thread.tid, NT_PRSTATUS, skipping_call(own, size))

    def await_end(self) -> Ending:
        """Wait until the program has ended; what it has started is killed then."""
        return self._end().ending

    def is_outside(self, sender: int) -> bool:
        """Whether the sender of a signal is none of the program's processes, as far as they live."""
        if self._own_pids:
            return sender == 0
        return sender not in {thread.pid for thread in self.threads.values()}

    def run_to_end(self, limit_s: float) -> bool:
        """Run to the end; False if that does not come within a limit of wall time."""
        deadline = time.monotonic() + limit_s
        self.resume_all()
        while self.main is not None:
            told = self.next_report(deadline - time.monotonic())
            if told is None:
                return False
            thread, report = told
            if report.kind != "gone":
                self.resume(thread)
        return True

    def kill(self) -> None:
        """Kill the program, if it has not ended; what it has started lives on until the end of ``with``."""
        with suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)

    def detach_all(self) -> None:
        """Kill all that is left: nothing outlives its run."""
        for thread in self.threads.values():
            with suppress(ProcessLookupError):
                os.kill(thread.pid, signal.SIGKILL)
        wait_until(self._are_gone, DEATH_LIMIT_S)

    def _are_gone(self) -> bool | None:
        """Take in the ends of threads that were killed; the first of a process ends after the others."""
        for tid in list(self.threads):
            report = ptrace.poll(tid)
            if report is not None and report.kind == "gone":
                del self.threads[tid]
            elif report is not None:
                with suppress(GoneError):
                    ptrace.resume(tid)
        return None if self.threads else True

    def __exit__(self, *_: object) -> None:
        try:
            super().__exit__()
            self.await_end()
        finally:
            if hasattr(self, "process"):
                self.process.close()

    def await_one(self, thread: Tracee) -> StopReport:
        """Wait for what one thread reports."""
        return self._take_in(thread, ptrace.await_report(thread.tid))

    def next_report(self, limit_s: float) -> tuple[Tracee, StopReport] | None:
        """What one of the running threads reports, who stands then; None after a limit of wall time."""
        return wait_until(self._look_at_one, limit_s, _SLEEP_S)

    def _look_at_one(self) -> tuple[Tracee, StopReport] | None:
        for thread in self._running():
            report = self._look(thread)
            if report is not None:
                return thread, report
        return None


@dataclass(frozen=True, slots=True)
class _Answer:
    ending: Ending
    problem: str


def _key(number: int, size: int) -> bytes:
    """The bytes of the ``number``-th key: drawn once, by us."""
    return hashlib.shake_128(f"zenfi program {number}".encode()).digest(size)


def resolved(command: str) -> str:
    """The file of a program, as a shell finds it.

    :raises LaunchError: if there is none that can be executed.
    """
    found = shutil.which(command)
    if found is None:
        message = f"{command}: no such program"
        raise LaunchError(message)
    return str(Path(found).absolute())
