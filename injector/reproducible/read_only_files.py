"""Files that a struck program cannot change: it finds all file systems read-only but a few folders.

A fault may have a program remove or overwrite what its user keeps, and later runs would find that. In a mount
namespace of our own we mount what is there anew. See mount_namespaces(7) and mount_setattr(2).
"""

from __future__ import annotations

import ctypes
import os
import struct
from collections.abc import Sequence
from pathlib import Path

from injector.reproducible.forked_question import answered_by_a_fork
from services.system.libc import checked, libc

KERNEL_FOLDERS = ("/proc", "/dev/shm")  # noqa: S108 - where memory is shared, not files kept
"""What lies there is no file, or nobody's in particular."""

_NEWNS = 0x00020000
_BIND, _RECURSIVELY, _PRIVATE = 1 << 12, 1 << 14, 1 << 18
_MOUNT_SETATTR, _HERE, _AT_RECURSIVE, _READ_ONLY = 442, -100, 0x8000, 1
_ATTRIBUTES = struct.Struct("=QQQQ")


def make_all_read_only(but: Sequence[str]) -> bool:
    """Make all files read-only to this process and those that it starts, ``but`` those in some folders.

    Whether that is allowed here; if not, nothing is changed. Only a process of one thread may ask.
    """
    folders = (*but, *KERNEL_FOLDERS)
    if not answered_by_a_fork(lambda: _make_read_only(folders)):
        return False
    return _make_read_only(folders)


def _make_read_only(but: Sequence[str]) -> bool:
    checked(libc.unshare(_NEWNS))
    checked(libc.mount(None, b"/", None, _RECURSIVELY | _PRIVATE, None))
    writable = [os.fsencode(folder) for folder in but if Path(folder).is_dir()]
    for folder in writable:
        if not os.path.ismount(folder):
            checked(libc.mount(folder, folder, None, _BIND | _RECURSIVELY, None))
    _set_attributes(b"/", _AT_RECURSIVE, _ATTRIBUTES.pack(_READ_ONLY, 0, 0, 0))
    for folder in writable:
        _set_attributes(folder, 0, _ATTRIBUTES.pack(0, _READ_ONLY, 0, 0))
    return True


def _set_attributes(folder: bytes, flags: int, attributes: bytes) -> None:
    size = ctypes.c_size_t(len(attributes))
    checked(libc.syscall(_MOUNT_SETATTR, _HERE, folder, flags, attributes, size))
