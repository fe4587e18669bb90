"""Whether a flight of which nothing is heard stands still, or has something to compute on a busy machine."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Protocol

from deploy.errors import DisturbedFlightError
from services.system.process_stat import children, wants_processor

STALL_S = 20.0
"""Wall time without a message or promise after which somebody must be hanging outside a step."""

LOOK_S = 1.0
"""Between two looks no more wall time counts than this: the machine, or we, stood still."""

LOOKS, PAUSE_S = 25, 0.02
"""So often it is looked whether somebody computes, and so long apart."""


class Watched(Protocol):
    """Whoever has started the processes of a flight."""

    def refresh(self) -> list[str]:
        """The names of the processes that somebody has stopped."""

    def pids(self) -> list[int]:
        """The processes of the flight on this host, those that pass on their messages too."""

    def cpu_s(self) -> float:
        """Processor time of the nodes on this host that are alive."""


class Silence:
    """How long nothing has been heard of a flight, not counting what is nobody's fault.

    ``most_cpu_s`` is the processor time that the nodes' steps may use without a message, at most: who uses
    still :data:`STALL_S` more is in no step, but was spoilt.
    """

    def __init__(self, watched: Watched, most_cpu_s: float) -> None:
        self._watched, self._most_cpu_s = watched, most_cpu_s
        self._quiet_s = self._stopped_s = 0.0
        self._cpu_s: float | None = None

    def look(self, since_s: float, *, heard: bool) -> None:
        """Take note of whether anything was heard since the last look, ``since_s`` ago.

        :raises DisturbedFlightError: if a process was stopped from outside for long.
        """
        if heard:
            self._quiet_s = self._stopped_s = 0.0
            self._cpu_s = None
            return
        if self._cpu_s is None:
            self._cpu_s = self._watched.cpu_s()
        if stopped := self._watched.refresh():
            # Who goes on in time has all the time that others have.
            self._quiet_s, self._stopped_s = 0.0, self._stopped_s + min(since_s, LOOK_S)
            if self._stopped_s > STALL_S:
                message = f"{', '.join(stopped)} was stopped from outside"
                raise DisturbedFlightError(message)
        else:
            self._quiet_s += min(since_s, LOOK_S)

    def is_stall(self) -> bool:
        """Whether somebody keeps all others waiting; who waits for a processor does not. It begins anew."""
        if self._quiet_s <= STALL_S:
            return False
        self._quiet_s = 0.0
        used_s = self._watched.cpu_s() - (self._cpu_s or 0.0)
        return used_s > STALL_S + self._most_cpu_s or not computes(self._watched.pids())


def computes(pids: Sequence[int]) -> bool:
    """Whether one of some processes runs or waits for a processor, most of the times that it is looked.

    So does who waits for a copy of itself that does.
    """
    seen = 0
    for _ in range(LOOKS):
        copies = [copy for pid in pids for copy in children(pid)]
        seen += any(map(wants_processor, (*pids, *copies)))
        time.sleep(PAUSE_S)
    return 2 * seen > LOOKS
