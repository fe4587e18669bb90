"""Functions of the C library for compiled loops, which leave the interpreter as it is.

A loop of the interpreter leaves traces: it counts how often code is run and rewrites what runs often (PEP
659), and an attribute that is then looked up another way takes another one's place in a cache. So two
processes that have gone round it a different number of times differ in their memories.
"""

from __future__ import annotations

import platform
from typing import Any

from numba import njit, types
from numba.np.numpy_support import carray

CLONE = {"x86_64": 56, "aarch64": 220}[platform.machine()]
"""The number of the system call."""

_types: Any = types


def _function(name: str, result: Any, *arguments: Any) -> Any:
    return types.ExternalFunction(name, result(*arguments))


_int, _long, _size, _pointer = _types.intc, _types.long_, _types.uintp, _types.uintp

read = _function("read", _types.intp, _int, _pointer, _size)
recv = _function("recv", _types.intp, _int, _pointer, _size, _int)
send = _function("send", _types.intp, _int, _pointer, _size, _int)
fork = _function("fork", _int)
syscall = _function("syscall", _long, _long, _long, _long, _long, _long, _long)
waitpid = _function("waitpid", _int, _int, _pointer, _int)
getpid = _function("getpid", _int)
getppid = _function("getppid", _int)
prctl = _function("prctl", _int, _int, _long)
unshare = _function("unshare", _int, _int)
setns = _function("setns", _int, _int, _int)
exit_at_once = _function("_exit", _types.void, _int)
_errno_location = _function("__errno_location", _types.CPointer(_int))


@njit(cache=True)
def error() -> int:
    """The number of the error of what was called last."""
    return int(carray(_errno_location(), 1)[0])
