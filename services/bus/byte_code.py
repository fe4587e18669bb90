"""Whether Python had to compile what this process imported: its memory then is not that of other starts."""

from __future__ import annotations

import os
import sys
import time
from contextlib import suppress
from pathlib import Path

from services.bus.process_stat import CLOCK_TICKS_PER_S, process_stat


def wrote_byte_code() -> bool:
    """Whether byte code that we use has been written since this process began, or just before.

    A fork looks: what it reads about the process is never the same, and would leave the memory so. It takes
    a failure of its own for a yes.
    """
    pid = os.fork()
    if not pid:
        status = os.EX_SOFTWARE
        with suppress(BaseException):
            status = int(_newest_s() > time.time() - _age_s() - 1.0)
        os._exit(status)
    return os.waitpid(pid, 0)[1] != 0


def _newest_s() -> float:
    files = [getattr(module, "__cached__", None) for module in list(sys.modules.values())]
    return max(Path(file).stat().st_mtime for file in files if file and Path(file).exists())


def _age_s() -> float:
    began_ticks = process_stat(os.getppid()).start_ticks
    return time.clock_gettime(time.CLOCK_BOOTTIME) - began_ticks / CLOCK_TICKS_PER_S
