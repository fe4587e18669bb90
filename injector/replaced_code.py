"""Code of this process that is replaced while it runs. x86-64 only, as its callers are."""

from __future__ import annotations

import ctypes
import os


def replace_code(address: int, code: bytes) -> bytes:
    """Put ``code`` where it says, read it back, and return what was there; pages that are not ours become so.

    :raises OSError: if it is not there then.
    """
    before = ctypes.string_at(address, len(code))
    memory = os.open("/proc/self/mem", os.O_RDWR | os.O_CLOEXEC)
    try:
        os.pwrite(memory, code, address)
    finally:
        os.close(memory)
    if ctypes.string_at(address, len(code)) != code:
        message = f"the code at {address:#x} could not be replaced"
        raise OSError(message)
    return before
