"""Scouts: copies of a node that run an armed call ahead of it, so that it is known what there is to strike.

A scout is a fork of the node at the gate. It has the node's memory and only its main thread, runs the
same call in view of the injector and ends with it; it never reaches the session.
"""

from __future__ import annotations

import ctypes
import os

from services.bus.lifeline import die_with_parent

_fork = ctypes.PyDLL(None).fork
"""Other than that of CDLL and os.fork it leaves the interpreter as it is: node and scout go on alike."""


def fork_scout() -> bool:
    """Fork one; True in the scout, False in the node once the scout has ended.

    It leaves the node's memory as it was: a replay, which sends no scouts, is to find it alike. So no
    object is kept while another one comes and goes.

    :raises OSError: if there can be none.
    """
    node = os.getpid()
    if _fork() == 0:
        die_with_parent(node)
        return True
    os.waitpid(-1, 0)
    return False
