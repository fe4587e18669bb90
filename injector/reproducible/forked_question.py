"""Questions about this process that a fork answers, so that what it reads leaves nothing in our memory.

The text of ``/proc/self/status`` is as long as its numbers have digits, among them how often the process has
waited. Read here, a digit more would have it taken from elsewhere in the heap, and so all that comes after.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress


def answered_by_a_fork(question: Callable[[], bool]) -> bool:
    """What ``question`` answers in a fork of this process; False if it raises or the fork dies.

    In the fork, this process is the parent: ``os.getppid()``. Only a process of one thread may ask.
    """
    pid = os.fork()
    if not pid:
        answer = False
        with suppress(BaseException):
            answer = question()
        os._exit(os.EX_OK if answer else os.EX_SOFTWARE)
    return os.waitpid(pid, 0)[1] == 0
