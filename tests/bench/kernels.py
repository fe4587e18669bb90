"""How much of each kernel's time is Python's: every kernel on its sample, its thread sampled.

``python -m tests.bench.kernels [SECONDS]``: a perf event notes the instruction pointer after every
100 us of the thread's own time in user mode, and the memory map tells whose code that is. *Python* is the
interpreter and numba's dispatcher; *native* are libraries and what numba compiled; *binding* are the
extension modules between the two, NumPy among them; what libc does is done for any of them. A kernel's
Python must not exceed its native part and bindings, ``pid`` aside: that call takes microseconds.
Source: perf_event_open(2), "MMAP layout".
"""

from __future__ import annotations

import ctypes
import fcntl
import mmap
import os
import struct
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from services.kernels import KERNELS

PERIOD_NS = 100_000
_PERF_EVENT_OPEN = 298
_TYPE_SOFTWARE, _COUNT_TASK_CLOCK, _SAMPLE_IP = 1, 1, 1
_ATTR_SIZE = 128
_DISABLED, _EXCLUDE_KERNEL, _EXCLUDE_HV = 1 << 0, 1 << 5, 1 << 6
_ENABLE, _DISABLE = 0x2400, 0x2401
_PAGES = 128
_HEAD_AT = 1024  # of data_head in the first page
_RECORD_SAMPLE = 9
_INTERPRETER = ("python", "libpython", "_dispatcher", "_dynfunc", "_helperlib")
_BINDING = ".cpython-"
_LIBC = ("libc.so", "libc-", "ld-linux", "libm.so", "libm-")


@contextmanager
def sampled(pointers: list[int]) -> Iterator[None]:
    """Add the instruction pointers of this thread while the body runs."""
    flags = _DISABLED | _EXCLUDE_KERNEL | _EXCLUDE_HV
    attributes = struct.pack(
        "=IIQQQQQ", _TYPE_SOFTWARE, _ATTR_SIZE, _COUNT_TASK_CLOCK, PERIOD_NS, _SAMPLE_IP, 0, flags
    )
    libc = ctypes.CDLL(None, use_errno=True)
    buffer = ctypes.create_string_buffer(attributes, _ATTR_SIZE)
    descriptor = int(libc.syscall(_PERF_EVENT_OPEN, buffer, 0, -1, -1, ctypes.c_ulong(0)))
    if descriptor < 0:
        raise OSError(ctypes.get_errno(), "perf_event_open: see zenfi doctor")
    ring = mmap.mmap(descriptor, (1 + _PAGES) * mmap.PAGESIZE)
    try:
        fcntl.ioctl(descriptor, _ENABLE)
        yield
        fcntl.ioctl(descriptor, _DISABLE)
        (head,) = struct.unpack_from("=Q", ring, _HEAD_AT)
        assert head < _PAGES * mmap.PAGESIZE, "the ring is full"
        at = mmap.PAGESIZE
        while at < mmap.PAGESIZE + head:
            kind, _, size = struct.unpack_from("=IHH", ring, at)
            if kind == _RECORD_SAMPLE:
                pointers.append(struct.unpack_from("=Q", ring, at + 8)[0])
            at += size
    finally:
        ring.close()
        os.close(descriptor)


def owners(pointers: list[int]) -> Counter[str]:
    """How many of the pointers lie in which mapped file; compiled by numba: ``jit``."""
    maps = []
    for line in Path("/proc/self/maps").read_text().splitlines():
        span, *_, name = (line + " ").split(maxsplit=5) if line.count(" ") > 5 else [*line.split(), ""]
        low, high = (int(end, 16) for end in span.split("-"))
        maps.append((low, high, Path(name.strip()).name or "jit"))
    found: Counter[str] = Counter()
    for pointer in pointers:
        found[next((name for low, high, name in maps if low <= pointer < high), "kernel")] += 1
    return found


def part_of(file: str) -> str:
    if file.startswith(_INTERPRETER):
        return "Python"
    if file.startswith(_LIBC):
        return "libc"
    return "binding" if _BINDING in file else "native"


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 1.0
    columns = "".join(f"{name:>10}" for name in ("us a call", "native %", "binding %", "Python %", "libc %"))
    print(f"{'kernel':16}{columns}  most of it in")
    for kernel in KERNELS.values():
        trial = kernel.trial(kernel.sample())
        trial.run()
        pointers: list[int] = []
        calls, begin = 0, time.thread_time()
        with sampled(pointers):
            while time.thread_time() - begin < seconds:
                trial.run()
                calls += 1
        spent = time.thread_time() - begin
        files = owners(pointers)
        found: Counter[str] = Counter()
        for name, count in files.items():
            found[part_of(name)] += count
        parts = [found[part] for part in ("native", "binding", "Python", "libc")]
        shares = "".join(f"{100 * part / max(len(pointers), 1):10.1f}" for part in parts)
        most = ", ".join(f"{name} {100 * count / len(pointers):.0f}" for name, count in files.most_common(4))
        print(f"{kernel.name:16}{1e6 * spent / calls:10.1f}{shares}  {most}")


if __name__ == "__main__":
    main()
