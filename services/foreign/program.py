"""An executable in a stage's place, and the protocol on its standard input and output.

Lines of text, each followed by as many bytes as its last word says where that is a size. docs/own_stack.md
has the protocol.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import time
from collections.abc import Iterable
from typing import NamedTuple, NoReturn

from services.bus.horizon import Stamped
from services.models.own_stack import OwnStage
from services.system.libc import libc
from services.system.lifeline import die_with_parent

VERSION = 1
LARGEST = 1 << 28
"""Bytes of a message beyond which it is none."""

FAREWELL_S = 1.0
"""Wall time that a program has at the end of a mission to end by itself."""

_LONGEST_LINE = 256
_AT_ONCE = 1 << 16
_PR_SET_PTRACER = 0x59616D61
_CPUCLOCK_OF_PROCESS = 2


class ProgramError(Exception):
    """A program sent malformed output, or exited too early."""


class ProgramDiedError(Exception):
    """A program ended. ``status`` is that of :class:`subprocess.Popen`: negative for a signal."""

    def __init__(self, status: int) -> None:
        super().__init__(f"ended with status {status}")
        self.status = status


class ProgramOutput(NamedTuple):
    """A message that a program publishes: CDR bytes."""

    topic: str
    payload: bytes


def greeting(stage: str, life: int, mission: bytes) -> bytes:
    """The first message to a program: what it is, and its mission as JSON."""
    return b"zenfi %d %s %d %d\n%b" % (VERSION, stage.encode(), life, len(mission), mission)


def step(messages: Iterable[tuple[str, Stamped]], now_ns: int) -> bytes:
    """One step: what has become visible, by topic, and the virtual time."""
    parts = []
    for topic, one in messages:
        parts.append(b"message %s %d %d %d\n" % (topic.encode(), one.seq, one.ready_ns, len(one.payload)))
        parts.append(one.payload)
    return b"".join([*parts, b"step %d\n" % now_ns])


class StageProgram:
    """A running executable. It dies with the process that started it."""

    def __init__(self, stage: OwnStage, tracer_pid: int) -> None:
        """Start the executable; ``tracer_pid`` (0: nobody) may trace it.

        :raises ProgramError: if that cannot be.
        """
        owner = os.getpid()

        def prepare() -> None:
            die_with_parent(owner)
            if tracer_pid:
                libc.prctl(_PR_SET_PTRACER, tracer_pid, 0, 0, 0)

        try:
            self._process = subprocess.Popen(  # noqa: S603 - what the specification names, by no shell
                stage.command,
                bufsize=0,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                cwd=stage.folder,
                preexec_fn=prepare,  # noqa: PLW1509 - this process has one thread
            )
        except (OSError, subprocess.SubprocessError) as error:
            message = f"{stage.command[0]} cannot be run: {error}"
            raise ProgramError(message) from error
        self._heard = b""

    @property
    def pid(self) -> int:
        """The process id of the executable."""
        return self._process.pid

    @property
    def cpu_ns(self) -> int:
        """Processor time that all its threads have used (clock_getcpuclockid(3))."""
        return time.clock_gettime_ns((~self.pid << 3) | _CPUCLOCK_OF_PROCESS)

    def tell(self, words: bytes) -> None:
        """Write bytes to the standard input of the executable.

        :raises ProgramDiedError, ProgramError: if nobody listens any more.
        """
        assert self._process.stdin is not None  # noqa: S101 - asked for
        try:
            while words:
                words = words[self._process.stdin.write(words) or 0 :]
        except BrokenPipeError:
            self._gone()

    def await_ready(self) -> None:
        """Wait until the executable reports that it is ready.

        :raises ProgramDiedError, ProgramError: if it says something else.
        """
        line = self._line()
        if line != ["ready"]:
            message = f"expected: ready, got {line!r}"
            raise ProgramError(message)

    def answer(self) -> list[ProgramOutput]:
        """The messages that the executable publishes in one step, in its order.

        :raises ProgramDiedError, ProgramError: if it says what is no answer.
        """
        made = []
        while (line := self._line()) != ["done"]:
            match line:
                case ["put", topic, size] if size.isascii() and size.isdigit() and int(size) <= LARGEST:
                    made.append(ProgramOutput(topic, self._take(int(size))))
                case _:
                    message = f"expected: put TOPIC BYTES, or done; got {line!r}"
                    raise ProgramError(message)
        return made

    def dismiss(self) -> None:
        """Close the executable's standard input and wait for it to exit by itself."""
        assert self._process.stdin is not None  # noqa: S101 - asked for
        self._process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(FAREWELL_S)

    def kill(self) -> None:
        """Kill the executable and reap it."""
        self._process.kill()
        self._process.wait()
        for end in (self._process.stdin, self._process.stdout):
            assert end is not None  # noqa: S101 - asked for
            end.close()

    def _line(self) -> list[str]:
        while b"\n" not in self._heard:
            if len(self._heard) > _LONGEST_LINE:
                message = f"a line of more than {_LONGEST_LINE} bytes"
                raise ProgramError(message)
            self._hear()
        line, _, self._heard = self._heard.partition(b"\n")
        return line.decode(errors="replace").split()

    def _take(self, size: int) -> bytes:
        while len(self._heard) < size:
            self._hear()
        taken, self._heard = self._heard[:size], self._heard[size:]
        return taken

    def _hear(self) -> None:
        assert self._process.stdout is not None  # noqa: S101 - asked for
        more = os.read(self._process.stdout.fileno(), _AT_ONCE)
        if not more:
            self._gone()
        self._heard += more

    def _gone(self) -> NoReturn:
        assert self._process.stdin is not None  # noqa: S101 - asked for
        self._process.stdin.close()  # one that closed its output may wait for more
        status = self._process.wait()
        if status == 0:
            raise ProgramError("it left before the mission's end")
        raise ProgramDiedError(status)
