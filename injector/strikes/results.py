"""What is asked of a striker and what it tells, line by line."""

from __future__ import annotations

from typing import Literal

from services.models.base import Strict
from services.models.faults.specification import FaultSpec
from services.models.outcome import InjectionRecord

TASKS, LINKS = "tasks.sock", "links.sock"
"""Sockets in the mission's folder: where who wants strikes listens, and where the striker does."""

LOG = "strikes.log"
"""In the same folder, what node and striker write."""

StrikeResult = Literal["same_memory", "same_messages", "strayed", "died", "hang", "undecided"]


class StrikeTask(Strict):
    """The faults to strike a node's calls with, each with a trigger that names its call, and the node's pid.

    ``end_ns`` is the virtual time at which the flight ended, ``seed`` the mission's. A node that is
    ``watched`` asks a detector, which found nothing in the flight.
    """

    node: str
    seed: int
    end_ns: int
    watched: bool = False
    faults: tuple[FaultSpec, ...]


class StrikeRecord(Strict):
    """What became of the ``index``-th fault of a task.

    ``same_memory``: the node's memory after the call is that of a copy that was not struck;
    ``same_messages``: it is not, and yet the node sent what it had sent to the end of the flight. Both prove
    the golden twin's outcome. ``strayed``: message ``number`` of ``topic`` was another one. ``died``: of
    ``cause``, a signal's name, the last line that the node wrote, or "exit status N". ``at_ns`` is when.
    ``undecided``: only a flight can tell. ``counts`` is what a node that sent the same had counted to the
    end. ``state`` tells in what its memory differed after the call: strikes on one call with the same state
    have the same flight.
    """

    index: int
    result: StrikeResult
    cause: str = ""
    topic: str = ""
    number: int = 0
    at_ns: int = 0
    state: str = ""
    counts: dict[str, list[int]] | None = None
    injection: InjectionRecord | None = None


class StrikeLine(Strict):
    """One line of a striker: a strike, or our own problem, or that all is told.

    With a ``problem`` nothing follows. It was ``disturbed`` if something from outside is to blame.
    """

    strike: StrikeRecord | None = None
    problem: str = ""
    disturbed: bool = False
    done: bool = False
