"""Scouts: copies of a node that run an armed call ahead of it, so that it is known what there is to strike.

A scout is a fork of the node at the gate. It has the node's memory and only its main thread, runs the
same call in view of the injector and ends with it; it never reaches the session.
"""

from __future__ import annotations

import ctypes
import os

from services.bus.lifeline import die_with_parent

_libc = ctypes.PyDLL(None, use_errno=True)
"""Other than CDLL and os.fork it leaves the interpreter as it is: node and scout go on alike."""


def fork_scout() -> bool:
    """Fork one; True in the scout, False in the node once the scout has ended.

    :raises OSError: if there can be none.
    """
    node = os.getpid()
    pid = int(_libc.fork())
    if pid < 0:
        raise OSError(ctypes.get_errno(), "no scout could be forked")
    if pid:
        os.waitpid(pid, 0)
        return False
    die_with_parent(node)
    return True
