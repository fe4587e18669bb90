"""What a mission orders from the companion computer on which its stages run, and what that reports.

Orders are Zenoh queries on one key of the companion's stack; each is answered by a report of all processes
that run there. The one that asks for news is answered once there are some.
"""

from __future__ import annotations

from typing import Literal

from services.models.base import Strict
from services.models.faults.specification import Trigger
from services.runtime.setup import NodeSetup

ALL_STACKS = "zenfi/stack"
"""The namespace in which stacks of all machines meet."""

ORDERS = "companion/orders"
"""Where a companion computer takes orders, in the namespace of its stack."""

FLIGHTS = "companion/flight"
"""Below it each mission has a liveliness token: its processes there end with it."""


class FlightTerms(Strict):
    """What the supervisor of a mission's processes is told: ``namespace`` is the mission's on the bus."""

    namespace: str
    hang_cpu_s: float
    traced: str
    armed: Trigger | None

    @property
    def token(self) -> str:
        """The name of the mission's liveliness token, below :data:`FLIGHTS`."""
        return self.namespace.rpartition("/")[2]


class CompanionOrder(Strict):
    """One order. ``hello`` needs nothing, ``open`` the terms, ``start`` a setup, ``kill`` a name.

    ``look`` asks for a report, ``await`` for one as soon as a process has ended. ``end`` waits ``grace_s``
    for the processes to end by themselves, ``close`` ends what is left and the flight.
    """

    do: Literal["hello", "open", "start", "kill", "look", "await", "end", "close"]
    terms: FlightTerms | None = None
    setup: NodeSetup | None = None
    name: str = ""
    grace_s: float = 0.0


class ProcessReport(Strict):
    """How a process is that runs on the companion computer; ``page`` are its counters, in hexadecimal."""

    pid: int
    life: int
    alive: bool
    crashes: int
    hangs: int
    causes: list[str]
    log_tail: str
    page: str


class EndReport(Strict):
    """The end of a process, as :class:`deploy.mission.fork_server.Exited` tells it."""

    name: str
    status: int
    by_another: bool


class CompanionReport(Strict):
    """The answer to an order; of two reports the one with the larger ``number`` is the newer one."""

    number: int = 0
    installation: str = ""
    fixed_pids: bool = False
    processes: dict[str, ProcessReport] = {}
    ended: list[EndReport] = []
    stopped: list[str] = []


class CompanionFailure(Strict):
    """The answer to an order that failed: refused, by somebody from outside, or by a failure of ours."""

    kind: Literal["refused", "disturbed", "failed"]
    text: str
