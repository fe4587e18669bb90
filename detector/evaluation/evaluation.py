"""How well a detector does on recorded flights, without flying again.

*False alarms*: every check of the golden flights, as the detector would have judged it in flight.
*Detection*: single flipped bits put into those checks (``detector/evaluation/flips.py``). *Delay*: flights
that were flown with a fault. A ROC is the share of flips found over the false alarms, as the limit of the
score moves.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from detector.evaluation.flips import Flip, detected, flips
from detector.schemes.base import LIMIT, Scheme
from detector.series.series import Series


class Make(Protocol):
    """Makes a detector for one flight."""

    def __call__(self, *, learning: bool) -> Scheme:
        """Make the detector; with ``learning`` it goes on learning in flight."""
        ...


WATCHED_FIELDS = ("sign", "exponent")
"""The bits that the paper's preprocessing looks at."""

_SCALES = np.geomspace(0.05, 20.0, 27)


@dataclass
class Tally:
    """Flips of one kind: how many, how many were found, and how far those missed moved the value."""

    flips: int = 0
    found: int = 0
    missed_by: list[float] = field(default_factory=list)

    def add(self, flip: Flip, *, caught: bool) -> None:
        """Count one flip, found or missed."""
        self.flips += 1
        self.found += caught
        if not caught:
            self.missed_by.append(abs(flip.after - flip.before))

    @property
    def rate(self) -> float:
        """The share of flips that were found; NaN if there were none."""
        return self.found / self.flips if self.flips else float("nan")

    def missed(self, quantile: float) -> float:
        """A quantile of how far the missed ones moved the value; 0 if none was missed."""
        finite = [by for by in self.missed_by if np.isfinite(by)]
        return float(np.quantile(finite, quantile)) if finite else 0.0


@dataclass
class Evaluation:
    """The evaluation of one detector: its alarms, scores and flips."""

    flights: int = 0
    seconds: float = 0.0
    checks: int = 0
    alarms: int = 0
    flights_alarmed: int = 0
    alarmed_states: Counter[str] = field(default_factory=Counter)
    scores: list[float] = field(default_factory=list)
    flip_scores: list[float] = field(default_factory=list)
    fields: dict[tuple[str, str], Tally] = field(default_factory=dict)
    beyond: dict[str, Tally] = field(default_factory=dict)
    injected: int = 0
    injected_sdc: int = 0
    early_alarms: int = 0
    delays_s: list[float] = field(default_factory=list)

    @property
    def alarms_per_hour(self) -> float:
        """False alarms per hour of golden flight."""
        return 3600.0 * self.alarms / self.seconds if self.seconds else float("nan")

    @property
    def alarms_per_flight(self) -> float:
        """False alarms per golden flight."""
        return self.alarms / self.flights if self.flights else float("nan")

    def confusion(self) -> dict[str, int]:
        """Flips of sign and exponent against golden checks."""
        tallies = [tally for (_, kind), tally in self.fields.items() if kind in WATCHED_FIELDS]
        found, flipped = sum(tally.found for tally in tallies), sum(tally.flips for tally in tallies)
        return {
            "true_positive": found,
            "false_negative": flipped - found,
            "false_positive": self.alarms,
            "true_negative": self.checks - self.alarms,
        }

    def roc(self) -> list[tuple[float, float, float]]:
        """(limit, false alarms per golden flight, share of sign and exponent flips found), limits rising."""
        golden, flipped = np.array(self.scores), np.array(self.flip_scores)
        return [
            (float(limit), float((golden > limit).sum()) / max(self.flights, 1), _share(flipped > limit))
            for limit in sorted({*_SCALES.tolist(), LIMIT})
        ]

    def area(self) -> float:
        """Area under the ROC over checks: the chance that a flip scores above a golden check, ties half."""
        golden, flipped = np.sort(self.scores), np.array(self.flip_scores)
        if not len(golden) or not len(flipped):
            return float("nan")
        below = np.searchsorted(golden, flipped, side="left") + np.searchsorted(golden, flipped, side="right")
        return float(below.mean() / (2.0 * len(golden)))


def _share(hits: NDArray[np.bool_]) -> float:
    return float(hits.mean()) if len(hits) else float("nan")


def evaluate(make: Make, flights: Iterable[Series], largest: dict[str, float], samples: int) -> Evaluation:
    """Judge golden and injected flights; ``samples`` values of each state of each golden one are flipped."""
    result = Evaluation()
    for flight in flights:
        if "injected_s" in flight.about:
            _injected(make(learning=True), flight, result)
        elif flight.spec.fault is None:
            _golden(make(learning=True), flight, result)
            _flipped(make(learning=False), flight, largest, samples, result)
    return result


def _golden(scheme: Scheme, flight: Series, result: Evaluation) -> None:
    result.flights += 1
    result.seconds += flight.about["time_s"]
    alarms = 0
    for stage, checks in flight.checks.items():
        for index in range(len(checks)):
            values = checks.values[checks.rows(index)]
            result.scores.append(scheme.score(stage, values))
            alarm = scheme.check(stage, values)
            if alarm is not None:
                alarms += 1
                result.alarmed_states[alarm.state] += 1
                scheme.reset(stage)
        result.checks += len(checks)
    result.alarms += alarms
    result.flights_alarmed += alarms > 0


def _flipped(
    scheme: Scheme, flight: Series, largest: dict[str, float], samples: int, result: Evaluation
) -> None:
    for flip in flips(flight, largest, samples, 0):
        score = detected(scheme, flight, flip)
        result.fields.setdefault((flip.state, flip.field), Tally()).add(flip, caught=score > LIMIT)
        if flip.field in WATCHED_FIELDS:
            result.flip_scores.append(score)
        if flip.beyond:
            result.beyond.setdefault(flip.state, Tally()).add(flip, caught=score > LIMIT)


def _injected(scheme: Scheme, flight: Series, result: Evaluation) -> None:
    """Time of the first alarm at or after the fault; those before it are false."""
    begin = float(flight.about["injected_s"])
    result.injected += 1
    result.injected_sdc += bool(flight.about.get("sdc"))
    first: list[float] = []
    for stage, checks in flight.checks.items():
        for index in range(len(checks)):
            if scheme.check(stage, checks.values[checks.rows(index)]) is None:
                continue
            scheme.reset(stage)
            if checks.times_s[index] < begin:
                result.early_alarms += 1
            else:
                first.append(float(checks.times_s[index]))
    if first:
        result.delays_s.append(min(first) - begin)


MUST_HOLD: Sequence[str] = (
    *(f"trajectory.{name}" for name in ("x", "y", "z", "vx", "vy", "vz")),
    *(f"command.v{axis}" for axis in "xyz"),
)
"""Waypoint position and velocity, and the command's: a change beyond the largest golden one must be found."""
