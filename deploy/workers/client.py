"""The owner's end of a worker process (:mod:`deploy.workers.worker`)."""

from __future__ import annotations

import contextlib
import select
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from deploy.config.workdir import sweep
from deploy.workers.protocol import ALIVE
from services.system.json_lines import LineReader


class WorkerDiedError(Exception):
    """The worker has died, and its flight with it."""


def start_worker(
    cpu: int | None = None, log: int | None = None, *, watched: bool = False
) -> subprocess.Popen[bytes]:
    """A worker on a processor (None: one that is free); its messages go to the file ``log``, or to ours.

    If it is ``watched``, it sends the status of its flights. It dies with the *thread* that starts it
    (prctl(2), PR_SET_PDEATHSIG).
    """
    options = [*([] if cpu is None else [str(cpu)]), *(["--watched"] if watched else [])]
    return subprocess.Popen(  # noqa: S603 - our own interpreter and module
        [sys.executable, "-P", "-m", "deploy.workers.worker", *options],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=log,
        start_new_session=True,
    )


class WorkerClient:
    """Sends a worker what to fly and reads its answers."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process = process
        self._lines = LineReader(self.output)

    @property
    def pid(self) -> int:
        """The process id of the worker."""
        return self._process.pid

    @property
    def output(self) -> int:
        """The descriptor that becomes readable when the worker answers."""
        assert self._process.stdout is not None  # noqa: S101 - asked for
        return self._process.stdout.fileno()

    @property
    def lives(self) -> bool:
        """Whether the worker's process is still running."""
        return self._process.poll() is None

    def send(self, order: str) -> None:
        """Send a mission: JSON of an :class:`~deploy.workers.protocol.WorkerOrder` in one line."""
        assert self._process.stdin is not None  # noqa: S101 - asked for
        with contextlib.suppress(BrokenPipeError):  # its end is noticed at the next read
            self._process.stdin.write(order.encode() + b"\n")
            self._process.stdin.flush()

    def hear(self) -> list[str]:
        """Whole lines that have come; waits for something to come.

        :raises WorkerDiedError: if the worker closed its output (it exited or was killed).
        """
        lines = self._lines.read()
        if lines is None:
            raise WorkerDiedError("the worker died")
        return [line.decode() for line in lines]

    def fly(self, order: str, period_s: float) -> Iterator[str]:
        """Yield every line about a mission, its answer last; an empty one each ``period_s`` of silence.

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
        """Kill the worker; its fork server and nodes end with it, and the folder of its flight is removed."""
        self._process.kill()
        with contextlib.suppress(BrokenPipeError):
            self._process.communicate()
        sweep(Path(tempfile.gettempdir()))
