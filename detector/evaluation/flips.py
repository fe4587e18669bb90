"""Single flipped bits in recorded flights: what a source-level fault would show a detector, without flying.

A flip strikes one value of one message. A row of a trajectory is shown twice: to the check of planning that
made it, and to that of control from the tick on at which it becomes the waypoint. What the vehicle would do
afterwards is not known offline, so only the check that first shows the corrupted value counts.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detector.schemes.base import Scheme
from detector.series.changes import CARRIED, changes, followed
from detector.series.monitored_states import DURATION, WATCHED
from detector.series.preprocessing import levels
from detector.series.series import Checks, Series
from services.runtime.rng import generator

MEMORY = 2
"""Checks that a scheme is shown before a corrupted one: as many as any of them remembers."""

_MOTION = tuple(f"trajectory.{name}" for name in ("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az"))
_MOTION_COLUMNS = {
    stage: [WATCHED[stage].index(name) for name in _MOTION] for stage in ("planning", "control")
}
_COUNTS = frozenset({"future_collision_seq", "trajectory_seq"})


@dataclass(frozen=True, slots=True)
class Show:
    """A check that shows the corrupted value: where the series has it, and which of its values change."""

    stage: str
    check: int
    row: int
    column: int


@dataclass(frozen=True, slots=True)
class Flip:
    """One bit of one value; ``beyond``: the change it makes exceeds the largest of any golden flight."""

    state: str
    bit: int
    field: str
    before: float
    after: float
    beyond: bool
    shows: tuple[Show, ...]


def largest_changes(flights: list[Series]) -> dict[str, float]:
    """By state the largest change of level, either way, that golden flights show at any stage."""
    largest: dict[str, float] = {}
    for flight in flights:
        for stage, checks in flight.checks.items():
            for name, found in changes(stage, checks).items():
                largest[name] = max(largest.get(name, 0.0), float(np.abs(found).max(initial=0.0)))
    return largest


def flips(flight: Series, largest: Mapping[str, float], samples: int, seed: int) -> Iterator[Flip]:
    """Every bit of ``samples`` values of each state, drawn over the flight's messages.

    Of a trajectory's rows only those that were tracked are drawn: the others move nothing.
    """
    for state in _states():
        places = _places(flight, state)
        draw = generator(seed, f"flips {state}", flight.spec.seed)
        for index in draw.choice(len(places), min(samples, len(places)), replace=False) if places else ():
            shows = places[index]
            first = shows[0]
            checks = flight.checks[first.stage]
            value = float(checks.values[checks.rows(first.check)][first.row, first.column])
            before = _before(checks, first)
            for bit in range(32 if _counts(state) else 64):
                after = flipped(value, bit, count=_counts(state))
                change = 0.0
                if before is not None:
                    change = float(np.diff(levels(state, np.array([before, after])))[0])
                yield Flip(state, bit, _field(bit, state), value, after, abs(change) > largest[state], shows)


def _before(checks: Checks, show: Show) -> float | None:
    """The value that a corrupted one is compared with, None if there is none."""
    row = int(checks.first[show.check]) + show.row
    known = followed(show.stage, checks)
    if show.stage == "control":
        return float(checks.values[row - 2, show.column]) if known[show.check - 1] else None
    if WATCHED[show.stage][show.column] in CARRIED:
        step = checks.rows(show.check - 1).stop - checks.rows(show.check - 1).start
        return float(checks.values[row - step, show.column]) if step else None
    return float(checks.values[row - 1, show.column]) if row and known[row - 1] else None


def flipped(value: float, bit: int, *, count: bool) -> float:
    """``value`` with one bit of its float64, or of its uint32, the other way round."""
    if count:
        return float(int(value) ^ (1 << bit))
    bits = np.array([value]).view(np.uint64) ^ np.uint64(1 << bit)
    return float(bits.view(np.float64)[0])


def detected(scheme: Scheme, flight: Series, flip: Flip) -> float:
    """The highest score of the checks that show a flip."""
    return max(_score(scheme, flight, show, flip) for show in flip.shows)


def _score(scheme: Scheme, flight: Series, show: Show, flip: Flip) -> float:
    checks = flight.checks[show.stage]
    scheme.reset(show.stage)
    for index in range(max(show.check - MEMORY, 0), show.check):
        scheme.check(show.stage, checks.values[checks.rows(index)])
    values = checks.values[checks.rows(show.check)].copy()
    if WATCHED[show.stage][show.column] == DURATION:
        values[show.row, show.column] += flip.after - flip.before
    elif _counts(flip.state) and show.stage == "planning":
        values[:, show.column] = flip.after
    else:
        values[show.row, show.column] = flip.after
    return scheme.score(show.stage, values)


def _states() -> Iterator[str]:
    """Every state that a message carries."""
    yield from WATCHED["perception"]
    yield from WATCHED["planning"]
    yield from (name for name in WATCHED["control"] if name.startswith("command."))


def _counts(state: str) -> bool:
    return state.rpartition(".")[2] in _COUNTS


def _field(bit: int, state: str) -> str:
    if _counts(state):
        return "count"
    return "sign" if bit == 63 else "exponent" if bit >= 52 else "mantissa"


def _places(flight: Series, state: str) -> list[tuple[Show, ...]]:
    """Where the flight has a value of this state."""
    if state in WATCHED["perception"]:
        column = WATCHED["perception"].index(state)
        return [
            (Show("perception", check, 0, column),) for check in range(1, len(flight.checks["perception"]))
        ]
    if state.startswith("command."):
        column = WATCHED["control"].index(state)
        return [(Show("control", check, 1, column),) for check in range(1, len(flight.checks["control"]))]
    column = WATCHED["planning"].index(state)
    if _counts(state):
        plans = flight.checks["planning"]
        made = [check for check in range(len(plans)) if not plans.empty(check)]
        return [(Show("planning", check, 0, column),) for check in made[1:]]
    seen = DURATION if state == "trajectory.t" else state
    tracked = WATCHED["control"].index(seen) if seen in WATCHED["control"] else None
    return [
        (Show("planning", plan, row, column),)
        + ((Show("control", tick, 1, tracked),) if tracked is not None else ())
        for plan, row, tick in _tracked(flight)
    ]


def _tracked(flight: Series) -> list[tuple[int, int, int]]:
    """Plan, row and tick of every row that became a waypoint."""
    plans, ticks = flight.checks["planning"], flight.checks["control"]
    rows: dict[bytes, tuple[int, int]] = {}
    for plan in range(len(plans)):
        motion = plans.values[plans.rows(plan)][:, _MOTION_COLUMNS["planning"]]
        rows |= {line.tobytes(): (plan, row) for row, line in enumerate(np.ascontiguousarray(motion))}
    motion = np.ascontiguousarray(ticks.values[1::2, _MOTION_COLUMNS["control"]])
    entered: NDArray[np.int64] = 1 + np.flatnonzero((motion[1:] != motion[:-1]).any(axis=1))
    found = ((rows.get(motion[tick].tobytes()), int(tick)) for tick in entered)
    return [(place[0], place[1], tick) for place, tick in found if place is not None]
