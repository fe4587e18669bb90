"""A call of a small C kernel in a fork of the test, which stands at its beginning to be copied."""

from __future__ import annotations

import ctypes
import faulthandler
import os
import shutil
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import pytest

from injector.kernel_study.remote_fork import RemoteForks
from injector.kernel_study.subject import MARK
from injector.reproducible.vdso import clocks_by_system_calls
from injector.tracing.tracee import Tracee
from injector.tracing.tracees import TraceeGroup
from injector.tracing.waiting import wait_until

PATIENCE_S = 60.0

_CALL = """
#include <signal.h>
#ifdef __cplusplus
extern "C" {
#endif
double kernel(void);
double call(void) { raise(SIGURG); double result = kernel(); raise(SIGURG); return result; }
#ifdef __cplusplus
}
#endif
"""


class Standing(NamedTuple):
    """A process at the beginning of its call; it tells the result on a pipe."""

    tracees: TraceeGroup
    forks: RemoteForks
    root: Tracee
    results: int

    def trace(self) -> list[int]:
        """The address of every instruction of the call, by single steps."""
        copy = self.forks.copy(self.root)
        found = self.tracees.trace(copy, 10**6)
        assert copy.report is not None
        assert copy.report.kind == "gate"
        self.forks.end(copy)
        return found

    def result(self, copy: Tracee) -> float | None:
        """Let a copy run to its end; what its kernel returned, None if it died before."""
        while copy.tid in self.tracees.threads:
            self.tracees.service()
            if copy.report is not None:
                self.tracees.resume(copy)
        with suppress(BlockingIOError):
            return float(os.read(self.results, 64))
        return None


@contextmanager
def standing(folder: Path, kernel: str, suffix: str = ".c") -> Iterator[Standing]:
    """The process; gone afterwards, with its copies. The ``suffix`` says which language the kernel is in."""
    compiler = shutil.which("cc" if suffix == ".c" else "c++")
    if compiler is None:
        pytest.skip(f"no compiler of {suffix} on this machine")
    source = (folder / "kernel").with_suffix(suffix)
    source.write_text(_CALL + kernel)
    library = folder / "kernel.so"
    command = [compiler, "-O1", "-fno-stack-protector", "-fcf-protection=none", "-shared", "-fPIC", "-o"]
    subprocess.run([*command, library, source], check=True)
    call = ctypes.CDLL(str(library)).call
    call.restype = ctypes.c_double
    results, tell = os.pipe()
    os.set_blocking(results, False)
    waits, go = os.pipe()
    pid = os.fork()
    if not pid:
        faulthandler.disable()
        clocks_by_system_calls()
        os.read(waits, 1)
        os.write(tell, f"{call():.17g}".encode())
        os._exit(0)
    try:
        with TraceeGroup(MARK, forks=True, ours=True) as tracees:
            tracees.seize([pid])
            os.write(go, b"x")
            root = tracees.threads[pid]

            def there() -> bool | None:
                tracees.service()
                return True if root.report is not None else None

            assert wait_until(there, PATIENCE_S)
            forks = RemoteForks(tracees)
            yield Standing(tracees, forks, root, results)
            for one in list(tracees.threads.values()):
                forks.end(one)
    finally:
        for descriptor in (results, tell, waits, go):
            os.close(descriptor)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGCHLD})
