"""A helper process that restores the code if the injector is killed while an instruction is corrupted.

It holds the target's memory open and reads from standard input what to write where, or an empty line: there
is nothing left to restore. If its input ends before that line, it restores the code.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from injector.tracing.process import Process, ProcessIdentity

_PROGRAM = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.SIG_IGN)
memory = int(sys.argv[1])
print(flush=True)
todo = None
for line in sys.stdin:
    todo = line.split()
    print(flush=True)
if todo:
    os.pwrite(memory, bytes.fromhex(todo[1]), int(todo[0]))
"""


class RestoredProcess(Process):
    """A process whose code is restored some 0.1 ms after we are killed while it is changed."""

    def __init__(self, expected: ProcessIdentity) -> None:
        self._restorer: subprocess.Popen[bytes] | None = None  # closed without one if it is gone
        super().__init__(expected)
        try:
            memory = self._mem()
        except OSError:
            self.close()
            raise
        self._restorer = subprocess.Popen(  # noqa: S603 - our own program
            [sys.executable, "-I", "-S", "-c", _PROGRAM, str(memory)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=[memory],
            start_new_session=True,
        )
        self._heard()

    @contextmanager
    def changed_code(self, address: int, code: bytes, true: bytes) -> Iterator[bytes]:
        """As :meth:`Process.changed_code`; the helper process knows meanwhile what to restore."""
        self._tell(f"{address} {true.hex()}")
        with super().changed_code(address, code, true) as read_back:
            yield read_back
        self._tell("")

    def _tell(self, line: str) -> None:
        assert self._restorer is not None  # noqa: S101 - started
        assert self._restorer.stdin is not None  # noqa: S101 - a pipe
        self._restorer.stdin.write(f"{line}\n".encode())
        self._restorer.stdin.flush()
        self._heard()

    def _heard(self) -> None:
        assert self._restorer is not None  # noqa: S101 - started
        assert self._restorer.stdout is not None  # noqa: S101 - a pipe
        self._restorer.stdout.readline()

    def close(self) -> None:
        """Close the process and wait until its helper process has ended."""
        if self._restorer is not None:
            self._restorer.communicate()
        super().close()
