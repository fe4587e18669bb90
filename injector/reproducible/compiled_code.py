"""Where numba keeps the machine code of processes of :mod:`injector.reproducible.launch`.

The code is read into their memory, with names that count what was compiled before it in the same process. So
it is compiled as a whole, by one process that found nothing but byte code: a folder of one installation is
filled under another name, and gets its own once it is complete. Its path in those processes is that of a
descriptor.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import platform
import shutil
import sys
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).parents[2]
"""The folder of our packages."""

BESIDE = Path(__file__).parent / "__pycache__"

_FOLDER, _LOCK = 111, 112
"""Descriptors of the folder, and of the lock of who fills it."""

PATH = f"/proc/self/fd/{_FOLDER}"
"""What numba is told: the same text whoever the user is."""

_UNFINISHED = ".new"
_KEPT = 8
"""Folders, of other versions of the sources or of Python, of which the oldest is deleted."""

_PACKAGES = ("services", "sim", "injector", "detector", "deploy")
_OF_PROCESSOR = ("model name", "flags", "Features", "CPU implementer", "CPU part")


def parent_folder(of: Mapping[str, str], beside: Path = BESIDE) -> Path:
    """Where a user's compiled code is: ``beside`` our own byte code, or in the user's cache.

    ``of`` is the user's environment; its NUMBA_CACHE_DIR comes first. What lies beside our byte code and
    belongs to somebody else is left alone: its code would be executed, and a process that may not add to it
    has another memory.
    """
    if of.get("NUMBA_CACHE_DIR"):
        return Path(of["NUMBA_CACHE_DIR"]).absolute() / "zenfi"
    folders = (beside / "compiled", beside, beside.parent)
    nearest = next(folder for folder in folders if folder.exists())
    if nearest.stat().st_uid == os.geteuid() and os.access(nearest, os.W_OK):
        return beside / "compiled"
    cache = of.get("XDG_CACHE_HOME") or f"{of.get('HOME') or Path.home()}/.cache"
    return Path(cache).absolute() / "zenfi" / "compiled"


def open_folder(parent: Path, settings: Mapping[str, str]) -> None:
    """Open the folder of this installation in ``parent``, for the program that this process executes next.

    If there is none, wait until no other process fills it, and have that program fill it. ``settings`` are
    those of numba.

    :raises OSError: if there can be no such folder.
    """
    wanted = parent / _installation(settings)
    parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not wanted.exists():
        lock = os.open(parent / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not wanted.exists():
            os.dup2(lock, _LOCK)  # held until the code is complete, or the process dies
            wanted = wanted.with_suffix(_UNFINISHED)
            shutil.rmtree(wanted, ignore_errors=True)
            wanted.mkdir()
        os.close(lock)
    opened = os.open(wanted, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    os.dup2(opened, _FOLDER)
    os.close(opened)


def folder() -> Path:
    """Where the folder of this process is in truth."""
    return Path(PATH).readlink()


def is_unfinished() -> bool:
    """Whether this process is the one that fills its folder, or a fork of that one."""
    return folder().suffix == _UNFINISHED


def leave() -> None:
    """Let go of the folder that is not filled yet: who comes first, this process perhaps, begins it anew."""
    os.close(_LOCK)


def finish() -> None:
    """The folder is complete: others, and this process once it has begun again, may have it."""
    unfinished = folder()
    unfinished.rename(unfinished.with_suffix(""))
    folders = [one for one in unfinished.parent.iterdir() if one.is_dir()]
    for old in sorted(folders, key=lambda one: -one.stat().st_mtime)[_KEPT:]:
        shutil.rmtree(old, ignore_errors=True)
    leave()


def _installation(settings: Mapping[str, str]) -> str:
    """A name for all that decides on the code: compilers, processor, and our sources.

    All of them, not those alone that are compiled: what numba keeps depends on what else was in the memory of
    the process that compiled, and with it the memory of all that load it.
    """
    about = [
        sys.version,
        platform.machine(),
        version("numba"),
        version("llvmlite"),
        str(sorted(settings.items())),
    ]
    about += [line for line in _processor() if line.startswith(_OF_PROCESSOR)]
    for package in _PACKAGES:
        for file in sorted((ROOT / package).rglob("*.py")):
            status = file.stat()
            about.append(f"{file} {status.st_mtime_ns} {status.st_size}")
    return hashlib.sha256("\n".join(about).encode()).hexdigest()[:16]


def _processor() -> list[str]:
    """What the kernel tells about the first processor."""
    return Path("/proc/cpuinfo").read_text().partition("\n\n")[0].splitlines()
