"""A copy of a node that runs alone: it speaks with a recorded bus, and we trace it."""

from __future__ import annotations

import select
import signal
import socket
from contextlib import suppress
from dataclasses import dataclass

from injector.strikes.recorded_bus import RecordedBus
from injector.tracing import ptrace
from injector.tracing.process import sleeps
from injector.tracing.ptrace import GoneError, StopReport
from injector.tracing.tracee import Tracee
from injector.tracing.tracees import TraceeGroup
from services.bus import proxy_link
from services.bus.proxy_link import ANSWER, Frame, NonsenseError, ProxyLink
from services.runtime.kernel_timer import GATE_SIGNAL
from services.system.process_stat import main_thread_stat, own_number

LOOK_MS = 5
"""Between two looks at a copy that neither says anything nor ends."""

ASLEEP_LOOKS = 100
"""Looks at which a copy sleeps, though it has its answer, before it is taken to wait for ever."""

SILENT_LOOKS = 20
"""Looks at a silent copy between two at the thread time that it takes; the first of these begins to count."""

FRAME_S = 5.0
"""Wall time for a frame to come to its end once it has begun."""

OPEN_GATE = ANSWER.pack(0, 0, 1)


class HangError(Exception):
    """A copy computes for longer than a hang is granted, or waits for nobody."""


class DisturbedCopyError(Exception):
    """Another process has sent a copy a signal, or killed it: what becomes of it is not the fault's doing."""


class NonsenseEndError(Exception):
    """A copy has sent what no node sends: in a flight it is killed for that."""


class DiedError(Exception):
    """A copy has ended: by a signal, or with an exit status."""

    def __init__(self, report: StopReport) -> None:
        super().__init__(f"signal {report.signal}, exit status {report.exit_status}")
        self.report = report


@dataclass
class CopiedNode:
    """A traced copy of a node, its socket's other end, and what it has been told and has said so far."""

    tracees: TraceeGroup
    thread: Tracee
    socket: socket.socket
    bus: RecordedBus
    limit_s: float

    def __post_init__(self) -> None:
        """Begin to listen to what the copy says."""
        self.socket.settimeout(FRAME_S)
        self._link = ProxyLink(self.socket)
        self._begin_s: float | None = None
        self._silent = self._asleep = 0

    def hear(self) -> Frame:
        """What the running copy says next.

        :raises DiedError: if it has ended.
        :raises HangError: if it computes for too long, or not at all.
        :raises NonsenseEndError: if it is what no node says.
        """
        self._begin_waiting()
        while not self._link.pending and not _ready(self.socket):
            self._look()
        try:
            frame = self._link.hear()
        except TimeoutError as error:
            raise HangError from error
        except NonsenseError as error:
            raise NonsenseEndError from error
        if frame is None:
            self.to_its_end()
        assert frame is not None  # noqa: S101 - it has ended otherwise
        return frame

    def to_the_mark(self) -> None:
        """Let the copy run to where it marks the beginning or the end of its call, and stands.

        :raises DiedError: if it has ended.
        :raises HangError: if it computes for too long.
        """
        self._begin_waiting()
        if self.thread.report is not None:  # else it may stand at the mark already
            self.go()
        while True:
            report = ptrace.poll(self.thread.tid)
            if report is None:
                signal.sigtimedwait({signal.SIGCHLD}, LOOK_MS / 1000)
                self._require_progress()
            elif report.kind == "signal" and report.signal == GATE_SIGNAL:
                self.thread.report = StopReport("gate")
                return
            else:
                self._pass_on(report)

    def to_its_end(self) -> None:
        """Wait for the end of a copy that has hung up.

        :raises DiedError: with how it ended.
        """
        while True:
            self._look()

    def go(self) -> None:
        """Let the copy run on from where it stands."""
        self.thread.report = None
        with suppress(GoneError):
            ptrace.resume(self.thread.tid)

    def say(self, answer: bytes) -> None:
        """Give the copy the answer that it waits for."""
        with suppress(OSError):  # it has died; that is told of next
            self.socket.sendall(answer)

    def _look(self) -> None:
        report = ptrace.poll(self.thread.tid)
        if report is not None:
            self._pass_on(report)
        else:
            self._wait_a_little()

    def _wait_a_little(self) -> None:
        select.select([self.socket], [], [], LOOK_MS / 1000)
        self._require_progress()

    def _begin_waiting(self) -> None:
        self._begin_s, self._silent, self._asleep = None, 0, 0

    def _require_progress(self) -> None:
        self._silent += 1
        self._asleep += sleeps(self.thread.tid)
        if self._asleep >= ASLEEP_LOOKS:
            raise HangError
        if self._silent % SILENT_LOOKS == 0:
            cpu_s = self._cpu_s()
            if self._begin_s is None:
                self._begin_s = cpu_s
            elif cpu_s - self._begin_s > self.limit_s:
                raise HangError

    def _pass_on(self, report: StopReport) -> None:
        if report.kind == "gone":
            self.tracees.threads.pop(self.thread.tid, None)
            if report.signal == signal.SIGKILL:  # which no program sends itself
                raise DisturbedCopyError
            raise DiedError(report)
        deliver = report.signal if report.kind == "signal" and report.signal != GATE_SIGNAL else 0
        with suppress(GoneError):  # killed meanwhile; its end is reported next
            if deliver and ptrace.sent_by_another(self.thread.tid, own_number(self.thread.pid)):
                raise DisturbedCopyError
            ptrace.resume(self.thread.tid, deliver)

    def _cpu_s(self) -> float:
        try:
            return main_thread_stat(self.thread.pid).cpu_s
        except OSError:
            return 0.0


def asks_at_gate(frame: Frame) -> bool:
    """Whether the node stands at the injector's gate."""
    return frame.kind == proxy_link.ASK and frame.payload.startswith(b"gate/")


def _ready(end: socket.socket) -> bool:
    return bool(select.select([end], [], [], LOOK_MS / 1000)[0])
