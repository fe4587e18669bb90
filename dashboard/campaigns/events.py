"""What can happen to a campaign: the events of :mod:`dashboard.campaigns.state_machine`."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Begin:
    """A scheduler takes the campaign: leases of an earlier one are void, failed runs get a new chance."""


@dataclass(frozen=True, slots=True)
class Leased:
    """``runs`` are promised to a worker under ``lease``, which ends at ``until_s`` (monotonic)."""

    lease: str
    runs: tuple[int, ...]
    until_s: float


@dataclass(frozen=True, slots=True)
class RunStarted:
    """A worker has started to fly a run."""

    lease: str
    run: int


@dataclass(frozen=True, slots=True)
class Alive:
    """The worker was heard of: its lease now ends at ``until_s``."""

    lease: str
    until_s: float


@dataclass(frozen=True, slots=True)
class Flown:
    """A run was flown and has a result."""

    lease: str
    run: int


@dataclass(frozen=True, slots=True)
class NotFlown:
    """We failed to fly a run: not tried again by itself, for it would fail again."""

    lease: str
    run: int
    error: str


@dataclass(frozen=True, slots=True)
class Disturbed:
    """A process of a flight was ended from outside: an attempt, and the run is flown again."""

    lease: str
    run: int
    error: str


@dataclass(frozen=True, slots=True)
class Lost:
    """The worker is gone: what it was flying counts as an attempt, what it had not begun does not."""

    lease: str
    error: str


@dataclass(frozen=True, slots=True)
class LeaseTimePassed:
    """Time has passed: leases that ended before ``now_s`` are lost."""

    now_s: float


@dataclass(frozen=True, slots=True)
class NotNeeded:
    """The stopping rule has enough: every queued run is dropped."""


@dataclass(frozen=True, slots=True)
class Pause:
    """The scheduler leaves; what is in flight will be flown again, at no attempt's cost."""

    reason: str


@dataclass(frozen=True, slots=True)
class Cancel:
    """Somebody has cancelled the campaign."""


@dataclass(frozen=True, slots=True)
class CannotBegin:
    """Nothing of the campaign can be flown, as what it needs cannot be set up."""

    reason: str


Event = (
    Begin
    | Leased
    | RunStarted
    | Alive
    | Flown
    | NotFlown
    | Disturbed
    | Lost
    | LeaseTimePassed
    | NotNeeded
    | Pause
    | Cancel
    | CannotBegin
)
