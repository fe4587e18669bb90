"""What can happen to the processes of a stack, and what is to be done about it (:mod:`.states`).

``life`` counts the starts of one process: what is told of an earlier life is stale.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from deploy.compose.stack_file import ProcessSpec


@dataclass(frozen=True, slots=True)
class Declare:
    """These are the processes now: new ones begin, changed ones begin anew, the others end."""

    specs: Mapping[str, ProcessSpec]


@dataclass(frozen=True, slots=True)
class Want:
    """Somebody wants these processes, and what they need, to run."""

    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Unwant:
    """Somebody wants these processes to end, those first that need others of them."""

    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Again:
    """Somebody wants a process to end and to start again."""

    name: str


@dataclass(frozen=True, slots=True)
class Launched:
    """The process runs."""

    name: str
    life: int


@dataclass(frozen=True, slots=True)
class NotLaunched:
    """The process could not be started."""

    name: str
    life: int
    error: str


@dataclass(frozen=True, slots=True)
class Seen:
    """Every sign of readiness has been seen."""

    name: str
    life: int


@dataclass(frozen=True, slots=True)
class Ended:
    """The process and all that it had started are gone; ``status`` is negative for a signal."""

    name: str
    life: int
    status: int


@dataclass(frozen=True, slots=True)
class Passed:
    """Time has passed."""


Event = Declare | Want | Unwant | Again | Launched | NotLaunched | Seen | Ended | Passed


@dataclass(frozen=True, slots=True)
class Launch:
    """Start the process."""

    name: str
    life: int
    spec: ProcessSpec


@dataclass(frozen=True, slots=True)
class Ask:
    """Send the process its stop signal."""

    name: str
    signal: int


@dataclass(frozen=True, slots=True)
class Kill:
    """Kill the process and all that it has started."""

    name: str


Action = Launch | Ask | Kill
