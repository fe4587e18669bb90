"""A folder for what numba compiles, where neither our own folders nor the user's home can be written.

numba refuses to import a module with compiled functions if it cannot keep them anywhere. That is how a
service often runs: as a user without a home, from an installation that belongs to another one.
"""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import MutableMapping
from contextlib import suppress
from pathlib import Path

BESIDE = Path(__file__).parent / "__pycache__"
"""Where numba keeps what it compiles, if it may: beside byte code, in each folder of sources."""


def provide_numba_cache(environment: MutableMapping[str, str] = os.environ, beside: Path = BESIDE) -> None:
    """Name a private temporary folder to numba if it has no other one; to be called before it is imported.

    The folder is the same for all commands of a user, so that each thing is compiled once.
    """
    home = environment.get("XDG_CACHE_HOME") or f"{environment.get('HOME') or Path.home()}/.cache"
    if environment.get("NUMBA_CACHE_DIR") or _can_hold_files(beside) or _can_hold_files(Path(home) / "numba"):
        return
    folder = Path(tempfile.gettempdir()) / f"zenfi-{os.getuid()}"
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    status = folder.lstat()
    own = stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o077
    # What lies in a folder of somebody else would be executed.
    environment["NUMBA_CACHE_DIR"] = str(folder) if own else tempfile.mkdtemp(prefix="zenfi-")


def _can_hold_files(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
