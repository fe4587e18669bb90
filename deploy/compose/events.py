"""Events of a stack's processes and the actions that follow (:mod:`.state_machine`).

``life`` counts the starts of one process: an event of an earlier start is stale.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from deploy.compose.stack_file import ProcessSpec


@dataclass(frozen=True, slots=True)
class Declare:
    """The processes of the stack are declared: new ones begin, changed ones begin anew, the others end."""

    specs: Mapping[str, ProcessSpec]


@dataclass(frozen=True, slots=True)
class Want:
    """A client wants these processes, and those that they need, to run."""

    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Unwant:
    """A client wants these processes to end, first those that need others of them."""

    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Restart:
    """A client wants a process to end and to start again."""

    name: str


@dataclass(frozen=True, slots=True)
class Launched:
    """A process was started and runs under its reaper."""

    name: str
    life: int


@dataclass(frozen=True, slots=True)
class NotLaunched:
    """The process could not be started."""

    name: str
    life: int
    error: str


@dataclass(frozen=True, slots=True)
class SignsSeen:
    """Every sign of readiness has been seen."""

    name: str
    life: int


@dataclass(frozen=True, slots=True)
class NotAlive:
    """A process that was ready does not show any more that it works."""

    name: str
    life: int
    reason: str


@dataclass(frozen=True, slots=True)
class Ended:
    """The process and all that it had started are gone; ``status`` is negative for a signal.

    ``reason`` is why the supervisor ended it, if it did so because of a limit.
    """

    name: str
    life: int
    status: int
    reason: str = ""


@dataclass(frozen=True, slots=True)
class TimePassed:
    """A deadline or pause of a process may be over."""


Event = Declare | Want | Unwant | Restart | Launched | NotLaunched | SignsSeen | NotAlive | Ended | TimePassed


@dataclass(frozen=True, slots=True)
class Launch:
    """Start a process under a reaper of its own."""

    name: str
    life: int
    spec: ProcessSpec


@dataclass(frozen=True, slots=True)
class Probe:
    """The process is ready: from now on probe whether it works."""

    name: str


@dataclass(frozen=True, slots=True)
class Ask:
    """Send the process its stop signal."""

    name: str
    signal: int


@dataclass(frozen=True, slots=True)
class Kill:
    """Kill the process and all that it has started."""

    name: str


Action = Launch | Probe | Ask | Kill
