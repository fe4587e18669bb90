"""A kernel on its recorded sample, in a process that is made to be copied.

It stands at the beginning of the call for good. Faults are injected into copies of it, or of a copy that has
run a part of the call; each leaves what it made in memory that all share.
"""

from __future__ import annotations

import atexit
import ctypes
import gc
import mmap
import os
import signal
import struct
import time
from contextlib import suppress
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from injector.reproducible.vdso import clocks_by_system_calls
from services.kernels import Kernel
from services.runtime.kernel_trial import KernelOutput
from services.system.libc import libc_with_gil
from services.system.lifeline import die_with_parent

MARK = signal.SIGURG
"""What a copy sends itself at the beginning and the end of the call; its tracer takes it away."""

_ROOM = 4  # an output may be so many times as large as the good one
_HEADER = struct.Struct("<QQQ")  # how it ended, thread time in ns, bytes of the values
_SAME, _OTHER = 1, 2
_HUGE_PAGE = 2 << 20
_MADV_COLLAPSE = 25

libc_with_gil.madvise.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]


class CopyResult(NamedTuple):
    """What a copy made: the golden output, ``another`` or ``nothing``; thread time of its call, ns.

    Of another one: whether it is within the kernel's tolerance, and the largest difference of a value
    (None: there are more or fewer values, or not all are numbers).
    """

    what: Literal["golden", "another", "nothing"]
    spent_ns: int
    within_tolerance: bool = False
    deviation: float | None = None


class Subject:
    """The kernel, its golden output and the memory for the copies' outputs. One thread only."""

    def __init__(self, kernel: Kernel) -> None:
        self._kernel = kernel
        sample = kernel.sample()
        for _ in range(2):  # the first call compiles
            golden = kernel.trial(sample)
            golden.run()
        self._golden: KernelOutput = golden.output()
        self._trial = kernel.trial(sample)
        self._page = mmap.mmap(-1, _HEADER.size + _ROOM * max(self._golden.values.nbytes, mmap.PAGESIZE))
        gc.collect()
        gc.disable()
        gc.freeze()

    def fork(self) -> tuple[int, int]:
        """Start the process; its pid, and where to write a byte that sends it to the beginning of the call.

        To be called before anything else is imported: what it need not have makes copying slower.
        """
        waits, go = os.pipe2(os.O_CLOEXEC)
        worker = os.getpid()
        pid = os.fork()
        if pid == 0:
            status = os.EX_SOFTWARE
            with suppress(BaseException):
                die_with_parent(worker)
                _silence()
                clocks_by_system_calls()
                # One that leaves the interpreter ends there: to tear down all modules takes it as long as a
                # hang is waited for.
                atexit.register(os._exit, os.EX_OK)
                _collapse()
                if os.read(waits, 1):
                    self._run()
                    status = os.EX_OK
            os._exit(status)
        os.close(waits)
        return pid, go

    def _run(self) -> None:
        """The kernel between two marks; its output goes to the shared memory."""
        signal.raise_signal(MARK)
        self._trial.run()
        signal.raise_signal(MARK)
        spent_ns = time.thread_time_ns()  # since it was copied, that is
        # What matters of an output is worked out only where it is another one: it can take ten calls.
        same = self._trial.image() == self._golden.image
        values = b"" if same else np.asarray(self._trial.values(), dtype=np.float64).tobytes()
        room = len(self._page) - _HEADER.size
        self._page[_HEADER.size : _HEADER.size + min(room, len(values))] = values[:room]
        self._page[: _HEADER.size] = _HEADER.pack(_SAME if same else _OTHER, spent_ns, len(values))

    def forget(self) -> None:
        """Clear the shared memory before a copy runs: what other copies made is no longer there."""
        self._page[: _HEADER.size] = bytes(_HEADER.size)

    def made(self) -> CopyResult:
        """What the copy made that ran last, since :meth:`forget`."""
        end, spent_ns, length = (int(field) for field in _HEADER.unpack(self._page[: _HEADER.size]))
        if end == _SAME:
            return CopyResult("golden", spent_ns)
        if end != _OTHER:
            return CopyResult("nothing", spent_ns)
        golden = self._golden
        if length != golden.values.nbytes:
            return CopyResult("another", spent_ns)
        content = self._page[_HEADER.size : _HEADER.size + length]
        values = np.frombuffer(content, dtype=np.float64).reshape(golden.values.shape)
        tolerable = self._kernel.within_tolerance(golden, KernelOutput(b"", values))
        with np.errstate(invalid="ignore"):
            apart = np.where(values == golden.values, 0.0, np.abs(values - golden.values))
        largest = float(apart.max(initial=0.0))
        return CopyResult("another", spent_ns, tolerable, largest if np.isfinite(largest) else None)


def _silence() -> None:
    """Discard all output: what a copy says while it dies could be taken for ours."""
    nothing = os.open(os.devnull, os.O_RDWR | os.O_CLOEXEC)
    for descriptor in range(3):
        os.dup2(nothing, descriptor)


def _collapse() -> None:
    """Have our own memory in huge pages where the kernel can: there are 500 times fewer to copy then."""
    for line in Path("/proc/self/maps").read_text().splitlines():
        extent, permissions, _, _, _, *name = line.split(maxsplit=5)
        if permissions == "rw-p" and name in ([], ["[heap]"]):
            start, end = (int(bound, 16) for bound in extent.split("-"))
            for at in range(-(-start // _HUGE_PAGE) * _HUGE_PAGE, end - _HUGE_PAGE + 1, _HUGE_PAGE):
                libc_with_gil.madvise(at, _HUGE_PAGE, _MADV_COLLAPSE)
