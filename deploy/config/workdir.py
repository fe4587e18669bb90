"""The private folder of one mission: sockets and logs. Gone afterwards, also after ``kill -9``."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from services.bus.announce import start_ticks
from services.system.process_stat import process_stat

PREFIX = "zenfi-"
SOCKET_PATH_LIMIT = 107
"""Longest path of a Unix socket on Linux (``sockaddr_un``)."""

_LONGEST_NAME = len("/perception.sock.lock")


@contextmanager
def mission_folder() -> Iterator[Path]:
    """A folder of mode 0700, removed on leaving; what dead owners left is removed on entering.

    :raises ValueError: if the temporary folder's path is too long for a socket.
    """
    parent = Path(tempfile.gettempdir())
    sweep(parent)
    owner = f"{PREFIX}{os.getpid()}-{start_ticks(os.getpid())}-"
    folder = Path(tempfile.mkdtemp(prefix=owner, dir=parent))
    try:
        if len(str(folder)) + _LONGEST_NAME > SOCKET_PATH_LIMIT:
            message = (
                f"temporary folder {parent} has too long a path for sockets; set TMPDIR to a shorter one"
            )
            raise ValueError(message)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def sweep(parent: Path) -> None:
    """Remove the folders of missions whose process is gone."""
    for folder in parent.glob(f"{PREFIX}*-*-*"):
        pid, start, _ = folder.name.removeprefix(PREFIX).split("-", 2)
        if pid.isdigit() and start.isdigit() and not _alive(int(pid), int(start)):
            shutil.rmtree(folder, ignore_errors=True)


def _alive(pid: int, start: int) -> bool:
    try:
        found = process_stat(pid)
    except OSError:
        return False
    return found.state != "Z" and found.start_ticks == start
