"""Where one process of a stack can stand.

A process is

=========== ======================================================================================
pending     wanted; waits until what it needs is ready
starting    runs, and has not shown yet that it is ready; too long and it is stopped as a failure
ready       runs and is ready; has been so long enough and its restarts are counted anew
backing_off ended though it should run; starts again when the pause is over
stopping    was asked to end: to stay stopped, to start again, or as it was not ready in time; is
            killed when its grace is over
stopped     not wanted, and not running
exited      ended by itself, and its policy lets it: status 0, or a policy of ``never``
failed      could not be started, or ended once more than its policy tries again
=========== ======================================================================================
"""

from __future__ import annotations

import signal
from dataclasses import dataclass
from typing import Literal

Phase = Literal["pending", "starting", "ready", "backing_off", "stopping", "stopped", "exited", "failed"]

RUNNING: tuple[Phase, ...] = ("starting", "ready", "stopping")
AT_REST: tuple[Phase, ...] = ("stopped", "exited", "failed")
MOVING: tuple[Phase, ...] = ("starting", "backing_off", "stopping")
"""Those that end by themselves."""
NEVER_S = float("inf")


@dataclass(frozen=True, slots=True)
class ProcessState:
    """Where one process stands. ``until_s`` is when its phase ends if nothing happens before.

    ``restarts`` counts those by policy, ``in_a_row`` those since it last settled; ``late`` says that it
    is stopping because it was not ready in time, ``killed`` that its grace is over.
    """

    phase: Phase = "stopped"
    wanted: bool = False
    life: int = 0
    until_s: float = NEVER_S
    restarts: int = 0
    in_a_row: int = 0
    late: bool = False
    killed: bool = False
    reason: str = ""
    status: int | None = None


def told(status: int) -> str:
    """An exit status in words."""
    if status >= 0:
        return f"exit status {status}"
    try:
        return signal.Signals(-status).name
    except ValueError:
        return f"signal {-status}"
