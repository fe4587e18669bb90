"""A process on this machine: whether it is the one that was announced, its threads and its code."""

from __future__ import annotations

import mmap
import os
import select
import time
from bisect import bisect_right
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields
from pathlib import Path

from services.bus.announce import Announcement, boot_id, start_ticks
from services.system.process_stat import process_stat

LONGEST_INSTRUCTION = 15
"""Bytes (Intel SDM volume 2, section 2.3.11)."""


END_LIMIT_MS = 1000
"""Wall time for a killed process to be gone."""


class IdentityError(Exception):
    """A process is not what it was announced as; it is not touched."""


class VanishedError(IdentityError):
    """The announced process is gone, whether or not its pid is in use again."""


class ChangedError(IdentityError):
    """The process of that pid is another one than was announced, or has become another one."""


class CodeError(Exception):
    """There is no code to read at an address."""


class AddressError(Exception):
    """Memory at an address cannot be read or written."""


@dataclass(frozen=True, slots=True)
class ProcessIdentity:
    """What tells a process from every other one: on one boot ``pid`` and ``start_ticks``.

    ``start_ticks`` is field 22 of /proc/PID/stat; ``executable`` are device and inode of its file.
    """

    boot_id: str
    pid: int
    start_ticks: int
    uid: int
    executable: tuple[int, int]

    @classmethod
    def announced(cls, claim: Announcement) -> ProcessIdentity:
        """What a node must be if its claim is true: nodes run our executable, or a known one, as our user."""
        own = cls.of(os.getpid())
        return cls(claim.boot_id, claim.pid, claim.start_ticks, own.uid, claim.executable or own.executable)

    @classmethod
    def of(cls, pid: int) -> ProcessIdentity:
        """What a process is by the kernel's account.

        :raises VanishedError: if there is none.
        :raises IdentityError: if it is another user's and cannot be looked at.
        """
        try:
            executable = os.stat(f"/proc/{pid}/exe")  # noqa: PTH116 - a link that is followed
            uid = os.stat(f"/proc/{pid}").st_uid  # noqa: PTH116
            return cls(boot_id(), pid, start_ticks(pid), uid, (executable.st_dev, executable.st_ino))
        except PermissionError as error:
            message = f"process {pid} belongs to another user or may not be inspected"
            raise IdentityError(message) from error
        except OSError as error:
            message = f"process {pid} is gone"
            raise VanishedError(message) from error


@dataclass(frozen=True, slots=True)
class MemoryMapping:
    """A piece of a process's memory; ``path`` is empty where no file is behind it.

    ``permissions`` are as in /proc/PID/maps; ``name`` is the path or the kernel's name for it (``[vdso]``).
    """

    start: int
    end: int
    offset: int
    path: str
    permissions: str
    name: str


class MemoryMap:
    """The memory map of a process at one moment, as /proc/PID/maps tells it."""

    def __init__(self, text: str) -> None:
        self._lines = text.splitlines()

    def at(self, address: int) -> MemoryMapping | None:
        """The piece that an address lies in."""
        index = bisect_right(self._lines, address, key=lambda line: int(line.partition("-")[0], 16)) - 1
        if index < 0:
            return None
        mapping = _mapping(self._lines[index])
        return mapping if address < mapping.end else None

    def code(self) -> Iterator[MemoryMapping]:
        """The pieces that may be executed."""
        return (_mapping(line) for line in self._lines if "x" in line.split(maxsplit=2)[1])

    def writable(self) -> Iterator[MemoryMapping]:
        """The pieces that may be written."""
        return (_mapping(line) for line in self._lines if "w" in line.split(maxsplit=2)[1])

    def shared(self) -> Iterator[MemoryMapping]:
        """The pieces of which a write is seen by others, or in a file."""
        return (_mapping(line) for line in self._lines if "s" in line.split(maxsplit=2)[1])

    @property
    def extents(self) -> tuple[str, ...]:
        """Where pieces lie and what may be done with them, in order: ``"START-END PERMISSIONS"``."""
        return tuple(line[: line.index(" ", line.index(" ") + 1)] for line in self._lines)


def _mapping(line: str) -> MemoryMapping:
    extent, permissions, offset, _, _, *named = line.split(maxsplit=5)
    start, end = (int(bound, 16) for bound in extent.split("-"))
    name = named[0] if named else ""
    return MemoryMapping(start, end, int(offset, 16), name if name.startswith("/") else "", permissions, name)


class Process:
    """A process whose identity has been checked, held by a pidfd so that its pid cannot change hands."""

    def __init__(self, expected: ProcessIdentity) -> None:
        """Open a process and check its identity.

        :raises VanishedError: if it is gone.
        :raises ChangedError: if another one has its pid, or it is not as expected.
        """
        self.pid = expected.pid
        self._expected = expected
        self._memory: int | None = None
        try:
            self._pidfd = os.pidfd_open(self.pid)
        except ProcessLookupError as error:
            message = f"process {self.pid} is gone"
            raise VanishedError(message) from error
        try:
            self.verify()
        except IdentityError:
            self.close()
            raise

    @property
    def alive(self) -> bool:
        """Whether the process has not ended."""
        return not self.ends_within(0)

    def ends_within(self, limit_ms: int) -> bool:
        """Whether it has ended, or does so within some wall time."""
        poll = select.poll()
        poll.register(self._pidfd, select.POLLIN)
        return bool(poll.poll(limit_ms))

    def verify(self) -> None:
        """Compare the process with what was expected.

        :raises VanishedError: if it is gone.
        :raises ChangedError: naming the first thing that differs.
        """
        found = ProcessIdentity.of(self.pid)
        if not self.alive or found.start_ticks != self._expected.start_ticks:
            message = f"process {self.pid} is gone"
            raise VanishedError(message)
        for field in fields(ProcessIdentity):
            is_, was = getattr(found, field.name), getattr(self._expected, field.name)
            if is_ != was and field.name == "executable":
                runs = os.readlink(f"/proc/{self.pid}/exe")  # noqa: PTH115 - as the kernel tells it
                message = (
                    f"process {self.pid} is not the announced one: its executable is {runs} now; "
                    "of a launcher, name the program that it starts"
                )
                raise ChangedError(message)
            if is_ != was:
                message = f"process {self.pid} is not the announced one: {field.name} is {is_}, not {was}"
                raise ChangedError(message)

    def maps(self) -> MemoryMap:
        """Its memory map; empty if it is gone."""
        try:
            return MemoryMap(Path(f"/proc/{self.pid}/maps").read_text())
        except OSError:
            return MemoryMap("")

    def read_code(self, address: int) -> bytes:
        """The bytes of the longest instruction that may begin at ``address``, within its mapping.

        :raises CodeError: if there is no memory.
        """
        size = LONGEST_INSTRUCTION
        if address % mmap.PAGESIZE + size > mmap.PAGESIZE:
            mapping = self.maps().at(address)
            size = min(size, mapping.end - address) if mapping is not None else size
        try:
            return os.pread(self._mem(), size, address)
        except (OSError, OverflowError) as error:
            message = f"process {self.pid} has no code at {address:#x}"
            raise CodeError(message) from error

    def read_memory(self, address: int, size: int) -> bytes:
        """``size`` bytes of its memory.

        :raises AddressError: if they are not all there.
        """
        try:
            content = os.pread(self._mem(), size, address)
        except (OSError, OverflowError):
            content = b""
        if len(content) < size:
            message = f"process {self.pid} has no memory at {address:#x}"
            raise AddressError(message)
        return content

    def write_memory(self, address: int, content: bytes) -> None:
        """Change its memory, read-only pages too: of a private mapping, nobody else sees it.

        :raises AddressError: if it cannot be written.
        """
        try:
            written = os.pwrite(self._mem(), content, address)
        except (OSError, OverflowError):
            written = 0
        if written < len(content):
            message = f"the memory of process {self.pid} at {address:#x} cannot be written"
            raise AddressError(message)

    @contextmanager
    def changed_code(self, address: int, code: bytes, true: bytes) -> Iterator[bytes]:
        """Have other bytes for code, and the true ones again afterwards; what is read back of them.

        :raises AddressError: if it cannot be changed, or not be restored while the process lives.
        """
        try:
            self.write_memory(address, code)
            yield self.read_memory(address, len(code))
        finally:
            try:
                self.write_memory(address, true)
                restored = self.read_memory(address, len(true)) == true
            except AddressError:
                restored = False
            if not restored and not self.ends_within(END_LIMIT_MS):
                message = f"the instruction at {address:#x} could not be restored"
                raise AddressError(message)

    def _mem(self) -> int:
        if self._memory is None:
            self._memory = os.open(f"/proc/{self.pid}/mem", os.O_RDWR | os.O_CLOEXEC)
        return self._memory

    def close(self) -> None:
        """Close the pidfd and the memory of the process."""
        os.close(self._pidfd)
        if self._memory is not None:
            os.close(self._memory)

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def threads(pid: int) -> list[int]:
    """The threads of a process, in order; none if it is gone."""
    try:
        return sorted(int(name) for name in os.listdir(f"/proc/{pid}/task"))  # noqa: PTH208 - numbers
    except OSError:
        return []


class TaskFolder:
    """Counts a process's threads. Held open: quicker than to find it, and the pid cannot change hands."""

    def __init__(self, pid: int) -> None:
        """Open it, if the process is there."""
        self._descriptor: int | None = None
        with suppress(OSError):
            self._descriptor = os.open(f"/proc/{pid}/task", os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)

    def count(self) -> int:
        """How many threads there are; 0 if the process is gone. Much cheaper than listing them."""
        if self._descriptor is None:
            return 0
        return max(0, os.fstat(self._descriptor).st_nlink - 2)

    def close(self) -> None:
        """Close the folder; it cannot count any more."""
        if self._descriptor is not None:
            os.close(self._descriptor)


def has_ended(tid: int) -> bool:
    """Whether a thread is dead or gone, even if the rest of its process lives on."""
    return _state(tid) in "ZX"


def sleeps(tid: int) -> bool:
    """Whether a thread waits in a system call (or is gone)."""
    return _state(tid) in "SZX"


def _state(tid: int) -> str:
    """The one letter of proc_pid_stat(5); Z if the thread is gone."""
    try:
        return process_stat(tid).state
    except OSError:
        return "Z"


def cpu_s(pid: int) -> float:
    """Processor time of a process: its clock by the number that clock_getcpuclockid(3) gives it.

    :raises OSError: if it is gone.
    """
    return time.clock_gettime(~pid << 3 | 2)


def tracer_of(tid: int) -> int:
    """The thread that traces a thread; 0 if nobody does or it is gone."""
    try:
        status = Path(f"/proc/{tid}/status").read_text()
    except OSError:
        return 0
    return int(status.partition("TracerPid:")[2].split(maxsplit=1)[0])
