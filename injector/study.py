"""The kernel study: what one fault does to a kernel alone, thousands of times (the paper's Fig. 6).

A worker holds a kernel on its recorded sample. Each injection forks it: the copy runs the kernel once,
is struck on the way, and leaves its output in shared memory. The worker is the copy's parent and its
tracer, so nothing of a fault outlives its injection, and all copies begin alike to the byte.
"""

from __future__ import annotations

import gc
import mmap
import os
import select
import signal
import struct
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Literal

import numpy as np

from injector.session import inject
from injector.way import Call
from services.bus import rng
from services.bus.announce import Announcement, boot_id, start_ticks
from services.bus.lifeline import die_with_parent
from services.bus.mission import FaultSpec, Trigger
from services.bus.model import Strict
from services.bus.node import GATE_SIGNAL
from services.bus.outcome import InjectionRecord
from services.bus.trial import Output
from services.kernels import KERNELS, Kernel

StudyResult = Literal["benign", "sdc", "crash", "hang", "not_injected"]

HANG_TIMES = 20
"""A copy that uses this many times the thread time of a good call hangs, or ..."""

HANG_LEAST_S = 0.2
"""... this much, whichever is more."""

BLOCKED_S = 3.0
"""Wall time after which a copy that sleeps is taken to wait for ever."""

REHEARSALS = 7
"""Good calls by which the thread time of a call is known."""

_LOOK_MS = 10
_ROOM = 4  # an output may be so many times as large as the good one
_HEADER = struct.Struct("<QQQ")  # thread time in ns, bytes of the image, bytes of the values
_CLOCK_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


class StudyRun(Strict):
    """One injection into a kernel alone.

    ``sdc``: the output differs in a bit; ``within_tolerance`` says whether by no more than matters.
    ``cause``: of a crash, the signal or the exit status.
    """

    kernel: str
    index: int
    result: StudyResult
    within_tolerance: bool = False
    cause: str = ""
    injection: InjectionRecord


class Subject:
    """A kernel on its sample, of which copies are struck. Only in a process of one thread."""

    def __init__(self, kernel: Kernel) -> None:
        self._kernel = kernel
        sample = kernel.sample()
        for _ in range(2):  # the first call compiles
            golden = kernel.trial(sample)
            golden.run()
        self._golden: Output = golden.output()
        self._trial = kernel.trial(sample)
        room = _ROOM * (len(self._golden.image) + self._golden.values.nbytes)
        self._page = mmap.mmap(-1, _HEADER.size + room)
        self._boot_id = boot_id()
        gc.collect()
        gc.disable()
        gc.freeze()
        self._cpu_ns = 0
        self._cpu_ns = sorted(self._rehearse() for _ in range(REHEARSALS))[REHEARSALS // 2]

    def strike(self, index: int, fault: FaultSpec, seed: int) -> StudyRun:
        """Run a copy and inject ``fault`` into it, at a moment uniform over the thread time of a call."""
        draw = rng.generator(seed, f"study {self._kernel.name}", index)
        trigger = Trigger(invocation=0, cpu_ns=int(draw.random() * self._cpu_ns))
        aimed = fault.model_copy(update={"trigger": trigger, "seed": index})
        pid, go = self._fork()
        try:
            claim = Announcement(self._kernel.name, pid, pid, start_ticks(pid), self._boot_id)
            record = inject(Call(claim, 0, armed=lambda: _let_go(go), marked=True), [], aimed, draw)
            status = self._await(pid)
        finally:
            os.close(go)
        result, cause = self._judge(record, status)
        tolerable = result == "sdc" and self._within_tolerance()
        return StudyRun(
            kernel=self._kernel.name,
            index=index,
            result=result,
            within_tolerance=tolerable,
            cause=cause,
            injection=record,
        )

    # -- the copy ----------------------------------------------------------------------------------

    def _fork(self) -> tuple[int, int]:
        """Start a copy that waits for a byte; its pid, and where to write the byte."""
        self._page[: _HEADER.size] = bytes(_HEADER.size)
        waits, go = os.pipe2(os.O_CLOEXEC)
        worker = os.getpid()
        pid = os.fork()
        if pid == 0:
            status = os.EX_SOFTWARE
            with suppress(BaseException):
                die_with_parent(worker)
                if os.read(waits, 1):
                    self._run()
                    status = os.EX_OK
            os._exit(status)
        os.close(waits)
        return pid, go

    def _run(self) -> None:
        """The kernel between two marks; its output goes to the worker."""
        signal.raise_signal(GATE_SIGNAL)
        begin = time.thread_time_ns()
        self._trial.run()
        spent_ns = time.thread_time_ns() - begin
        signal.raise_signal(GATE_SIGNAL)
        image = self._trial.image()
        # What matters of an output is worked out only where it is another one: it can take ten calls.
        values = b"" if image == self._golden.image else self._trial.values().tobytes()
        written = (image + values)[: len(self._page) - _HEADER.size]
        self._page[: _HEADER.size] = _HEADER.pack(spent_ns, len(image), len(values))
        self._page[_HEADER.size : _HEADER.size + len(written)] = written

    def _rehearse(self) -> int:
        """The thread time of a good call in a copy, ns.

        :raises RuntimeError: if a copy does not make the golden output.
        """
        pid, go = self._fork()
        _let_go(go)
        os.close(go)
        status = self._await(pid)
        if status != 0 or self._image() != self._golden.image:
            message = f"{self._kernel.name}: a copy that was left alone made another output ({status})"
            raise RuntimeError(message)
        return int(_HEADER.unpack(self._page[: _HEADER.size])[0])

    def _await(self, pid: int) -> int | None:
        """How the copy ended: its exit status (negative: the signal), None if it hung and was killed."""
        cpu_limit_s = max(HANG_LEAST_S, HANG_TIMES * self._cpu_ns / 1e9)
        blocked = time.monotonic() + BLOCKED_S
        hung = False
        pidfd = os.pidfd_open(pid)
        try:
            ended = select.poll()
            ended.register(pidfd, select.POLLIN)
            while not ended.poll(_LOOK_MS):
                state, cpu_s = _looked_at(pid)
                if cpu_s > cpu_limit_s or (state == "S" and time.monotonic() > blocked):
                    hung = True
                    signal.pidfd_send_signal(pidfd, signal.SIGKILL)
        finally:
            os.close(pidfd)
        with suppress(ChildProcessError):  # it ended while it was traced
            status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
            return None if hung else status
        return -signal.SIGTRAP

    # -- what became of it -------------------------------------------------------------------------

    def _judge(self, record: InjectionRecord, status: int | None) -> tuple[StudyResult, str]:
        if record.status != "injected":
            return "not_injected", record.reason
        if status is None:
            return "hang", ""
        if status != 0:
            return "crash", signal.Signals(-status).name if status < 0 else f"exit status {status}"
        return ("benign" if self._image() == self._golden.image else "sdc"), ""

    def _image(self) -> bytes:
        length = int(_HEADER.unpack(self._page[: _HEADER.size])[1])
        return self._page[_HEADER.size : _HEADER.size + length]

    def _within_tolerance(self) -> bool:
        golden = self._golden
        _, image, length = (int(field) for field in _HEADER.unpack(self._page[: _HEADER.size]))
        if length != golden.values.nbytes or _HEADER.size + image + length > len(self._page):
            return False
        begin = _HEADER.size + image
        values = np.frombuffer(self._page[begin : begin + length], dtype=golden.values.dtype)
        faulty = Output(b"", values.reshape(golden.values.shape))
        return self._kernel.within_tolerance(golden, faulty)


def _let_go(go: int) -> None:
    with suppress(BrokenPipeError):
        os.write(go, b"x")


def _looked_at(pid: int) -> tuple[str, float]:
    """State and thread time in seconds of a process; of one that is gone, nothing."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return "", 0.0
    fields = stat.rpartition(")")[2].split()
    return fields[0], (int(fields[11]) + int(fields[12])) / _CLOCK_TICKS_PER_S


def main() -> None:
    """A worker: ``python -m injector.study KERNEL FAULT SEED COUNT SLOT SLOTS CPU``; JSON lines.

    It takes every ``SLOTS``-th injection of ``COUNT``, from ``SLOT`` on; ``FAULT`` is a FaultSpec in JSON.
    """
    kernel, fault, *numbers = sys.argv[1:]
    seed, count, slot, slots, cpu = (int(number) for number in numbers)
    die_with_parent()
    os.sched_setaffinity(0, {cpu})
    # What a struck copy says while it dies is of no use to anybody.
    os.dup2(os.open(os.devnull, os.O_WRONLY | os.O_CLOEXEC), 2)
    aimed = FaultSpec.model_validate_json(fault)
    subject = Subject(KERNELS[kernel])
    for index in range(slot, count, slots):
        sys.stdout.write(subject.strike(index, aimed, seed).model_dump_json(by_alias=True) + "\n")
        sys.stdout.flush()
    # Without the interpreter's own clean-up: nanobind would complain of OMPL's leaks at length.
    os._exit(os.EX_OK)


if __name__ == "__main__":
    main()
