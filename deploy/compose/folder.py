"""Private folders of stacks that are up: lock, control socket, bus. Where their logs are.

A stack's folder has a fixed name, so that every ``zenfi`` command finds it. It belongs to who holds the
lock, which the kernel frees whatever its holder dies of.
"""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from deploy.compose.stack_file import NAME, Stack
from deploy.config.workdir import SOCKET_PATH_LIMIT

CONTROL = "control.sock"
DYING_S = 5.0
"""How long a killed supervisor may take to let go: its lock is free when the last of its threads is gone."""

_LOCK = "lock"
_PAUSE_S = 0.01
_LONGEST_NAME = len("/" + 31 * "n" + ".sock.lock")


class StackError(ValueError):
    """A stack cannot do what was asked: one line that says why."""


class UnsafeFolderError(StackError):
    """A folder in which we would not be alone, or that cannot hold sockets."""


class TakenError(StackError):
    """A stack of that name is up already."""


def stacks_folder() -> Path:
    """Where this user's stacks are: ``$XDG_RUNTIME_DIR/zenfi``, or in the folder for temporary files."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime and Path(runtime).is_dir():
        return Path(runtime) / "zenfi"
    return Path(tempfile.gettempdir()) / f"zenfi-stacks-{os.getuid()}"


def stack_folder(name: str) -> Path:
    """The private folder of the stack of that name.

    :raises StackError: if it cannot be a stack's name.
    """
    if not re.fullmatch(NAME, name):
        message = f"{name!r} is no stack's name: lower-case letters, digits, - and _, at most 31"
        raise StackError(message)
    return stacks_folder() / name


def logs_folder(stack: Stack) -> Path:
    """Where a stack's logs are: where its file says, or in the user's folder for state."""
    if stack.logs:
        return Path(stack.logs)
    state = os.environ.get("XDG_STATE_HOME")
    return (Path(state) if state else Path.home() / ".local" / "state") / "zenfi" / stack.name


def log_file(logs: Path, name: str) -> Path:
    """The log of a process, or of the supervisor."""
    return logs / f"{name}.log"


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """The stack's folder, made if need be and ours alone; emptied on entering, removed on leaving.

    :raises TakenError: if a living supervisor holds it: one that does not let go in :data:`DYING_S`.
    :raises UnsafeFolderError: if others could enter it, or its path is too long for sockets.
    """
    if len(str(folder)) + _LONGEST_NAME > SOCKET_PATH_LIMIT:
        message = f"{folder} is too long a path for sockets; set XDG_RUNTIME_DIR or TMPDIR to a shorter one"
        raise UnsafeFolderError(message)
    _make_private(folder.parent)
    lock = _lock(folder)
    try:
        for left in folder.iterdir():
            if left.name != _LOCK:
                shutil.rmtree(left) if left.is_dir() else left.unlink()
        yield
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def _make_private(folder: Path) -> None:
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    check_private(folder)


def check_private(folder: Path) -> None:
    """Refuse a folder that somebody else may have put there.

    :raises UnsafeFolderError: naming it.
    :raises FileNotFoundError: if there is none.
    """
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        message = f"{folder} is not a folder of yours alone (mode 0700): remove it"
        raise UnsafeFolderError(message)


def _lock(folder: Path) -> int:
    deadline_s = time.monotonic() + DYING_S
    while True:
        # Its last holder may remove the folder between any two of our looks at it: then all over again.
        with suppress(FileNotFoundError):
            lock = _try_to_lock(folder)
            if lock is not None:
                return lock
            if time.monotonic() >= deadline_s:
                message = f"stack {folder.name} is up already"
                raise TakenError(message)
            time.sleep(_PAUSE_S)


def _try_to_lock(folder: Path) -> int | None:
    """The lock's descriptor; None while somebody else holds it.

    :raises FileNotFoundError: if the folder or its lock has been removed meanwhile.
    """
    _make_private(folder)
    lock = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.fstat(lock).st_ino != (folder / _LOCK).stat().st_ino:
            raise FileNotFoundError(folder)
    except BlockingIOError:
        os.close(lock)
        return None
    except FileNotFoundError:
        os.close(lock)
        raise
    return lock
