"""The owner's end of a worker process (:mod:`deploy.worker`)."""

from __future__ import annotations

import contextlib
import os
import select
import subprocess
import sys
from collections.abc import Iterator

from deploy.answer import ALIVE

READ_BYTES = 1 << 16


class WorkerDiedError(Exception):
    """The worker is gone, and what it was flying with it."""


def start_worker(
    cpu: int | None = None, log: int | None = None, *, watched: bool = False
) -> subprocess.Popen[bytes]:
    """A worker on a processor (None: one that is free); its messages go to the file ``log``, or to ours.

    If it is ``watched``, it tells how its flights stand. It dies with the *thread* that starts it (prctl(2),
    PR_SET_PDEATHSIG).
    """
    options = [*([] if cpu is None else [str(cpu)]), *(["--watched"] if watched else [])]
    return subprocess.Popen(  # noqa: S603 - our own interpreter and module
        [sys.executable, "-m", "deploy.worker", *options],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=log,
        start_new_session=True,
    )


class Worker:
    """Sends a worker what to fly and hears what it says."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process = process
        self._heard = b""

    @property
    def pid(self) -> int:
        """Its process."""
        return self._process.pid

    @property
    def output(self) -> int:
        """The descriptor to wait at."""
        assert self._process.stdout is not None  # noqa: S101 - asked for
        return self._process.stdout.fileno()

    @property
    def lives(self) -> bool:
        """Whether its process has not ended."""
        return self._process.poll() is None

    def send(self, order: str) -> None:
        """Have it fly a mission: JSON of an :class:`~deploy.order.Order` in one line."""
        assert self._process.stdin is not None  # noqa: S101 - asked for
        with contextlib.suppress(BrokenPipeError):  # its end is heard of in a moment
            self._process.stdin.write(order.encode() + b"\n")
            self._process.stdin.flush()

    def hear(self) -> list[str]:
        """Whole lines that have come; waits for something to come.

        :raises WorkerDiedError: if it has said its last.
        """
        data = os.read(self.output, READ_BYTES)
        if not data:
            raise WorkerDiedError("the worker died")
        *lines, self._heard = (self._heard + data).split(b"\n")
        return [line.decode() for line in lines]

    def fly(self, order: str, period_s: float) -> Iterator[str]:
        """Every line about a mission, its answer last; an empty one each ``period_s`` without a word.

        For workers that are not watched.

        :raises WorkerDiedError: if it dies on the way.
        """
        self.send(order)
        waiting = select.poll()
        waiting.register(self.output, select.POLLIN)
        while True:
            if not waiting.poll(period_s * 1000):
                yield ""
                continue
            for line in self.hear():
                yield line
                if line != ALIVE:
                    return

    def end(self) -> None:
        """Kill it; its fork server and nodes end with it."""
        self._process.kill()
        with contextlib.suppress(BrokenPipeError):
            self._process.communicate()
