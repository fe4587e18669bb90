"""Of the faults that harmed a flight, how many a detector catches in time, at how many false alarms.

Everything is told from recorded flights. A golden flight with an alarm is one false alarm: what follows the
first is no news to who reacts. The limit of the score is put on golden flights that nothing else is told
from, so that all schemes are compared at the same number of false alarms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy  # its parts are loaded when they are used

from detector.schemes.base import Floats
from detector.series.series import Series
from services.models.base import Strict
from services.models.faults.specification import FaultSpec
from services.recovery.reexecution import SCHEME

SECONDS = 3600.0
"""Of an hour."""

RISK = 0.1
"""That more flights have a false alarm than the budget allows: the limit makes it no likelier."""

TAIL = 0.1
"""The part of the flights, those with the largest scores, from which a limit beyond them all is told."""


class HarmReport(Strict):
    """What is known of a flight that a fault harmed; times are virtual, in seconds.

    ``struck`` is the node, sensor or motor; ``fault_class`` is ``once``, how the fault comes back, or
    ``equipment``.
    """

    struck: str
    target: str
    fault_class: str
    pilot: str
    cause: str
    injected_s: float
    harmed_at_s: float


def class_of(fault: FaultSpec) -> str:
    """The class that a fault counts in: once, how it recurs, or equipment."""
    return "equipment" if fault.at_equipment else fault.recurrence


@dataclass(frozen=True, slots=True)
class JudgedFlight:
    """The scores of all checks of a flight that took ``time_s``, in the order of their virtual times.

    ``times_s`` (n,) in seconds, ``scores`` (n,); ``harm`` is None for a golden flight.
    """

    time_s: float
    times_s: Floats
    scores: Floats
    harm: HarmReport | None = None

    @property
    def largest(self) -> float:
        """The largest score; 0 if there is none."""
        return float(self.scores.max(initial=0.0))

    def first_alarm_s(self, limit: float) -> float | None:
        """When the first check at or after the fault scores above a limit; None if none does."""
        begin = self.harm.injected_s if self.harm is not None else 0.0
        found = self.times_s[(self.scores > limit) & (self.times_s >= begin)]
        return float(found[0]) if len(found) else None


class Judge(Protocol):
    """What judges the checks of one flight: a scheme, or who answers in its stead."""

    @property
    def name(self) -> str:
        """The name under which the scheme is compared."""
        ...

    def score(self, stage: str, values: Floats) -> float:
        """The score of a stage's next check."""
        ...

    def check(self, stage: str, values: Floats) -> object | None:
        """Something if that check is an alarm."""
        ...

    def reset(self, stage: str) -> None:
        """Forget what a stage asked before."""
        ...


def judged(scheme: Judge, flight: Series) -> JudgedFlight:
    """Have a scheme judge all checks of a flight, as it would in flight with nobody listening to it.

    What re-execution found is in the recording.
    """
    times, scores = [], []
    for time_s in flight.about["differed_s"] if scheme.name == SCHEME else ():
        times.append(time_s)
        scores.append(np.inf)
    for stage, checks in flight.checks.items():
        for index in range(len(checks)):
            values = checks.values[checks.rows(index)]
            scores.append(scheme.score(stage, values))
            times.append(checks.times_s[index])
            if scheme.check(stage, values) is not None:
                scheme.reset(stage)
    order = np.argsort(times, kind="stable")
    harm = flight.about.get("harm")
    return JudgedFlight(
        float(flight.about["time_s"]),
        np.array(times, dtype=np.float64)[order],
        np.array(scores, dtype=np.float64)[order],
        None if harm is None else HarmReport.model_validate(harm),
    )


def limit_within(flights: Sequence[JudgedFlight], rate: float) -> float:
    """The limit that at most a part ``rate`` of such flights exceeds, with a confidence of 1 - ``RISK``.

    It is the binomial tolerance limit (Wilks 1941): the lowest score of these flights that says so. Where
    they are too few to say it, see :func:`limit_beyond`.
    """
    largest = np.sort([one.largest for one in flights])[::-1]
    law = scipy.stats.binom(len(largest), min(rate, 1.0))
    exceeding = int(law.ppf(RISK))
    exceeding -= bool(law.cdf(exceeding) > RISK)
    return float(largest[exceeding]) if exceeding >= 0 else limit_beyond(largest, rate)


def limit_beyond(largest: Floats, rate: float) -> float:
    """The limit that a part ``rate`` of flights exceeds if ``largest`` (n,), falling, has a Pareto tail.

    The tail's index is Hill's (1975), of the first tenth: at its upper bound with a confidence of 1 -
    ``RISK``, as n of them are over the true index a gamma variable of shape n. Whether the scores follow
    that law, so few flights cannot tell. At least the largest score.
    """
    top = max(int(TAIL * len(largest)), 1)
    begin = float(largest[min(top, len(largest) - 1)])
    if begin <= 0.0 or not np.isfinite(largest[0]):
        return float(largest[0])
    index = float(np.log(largest[:top] / begin).sum() / scipy.stats.gamma.ppf(RISK, top))
    expected = rate * len(largest)
    return max(float(largest[0]), begin * (top / expected) ** index) if expected else np.inf


@dataclass(frozen=True, slots=True)
class FaultVerdict:
    """What a detector said of one harmful fault: after how long, and how long the harm took."""

    harm: HarmReport
    alarm_s: float | None

    @property
    def in_time(self) -> bool:
        """Whether there was an alarm before the harm."""
        return self.alarm_s is not None and self.alarm_s < self.harm.harmed_at_s

    @property
    def margin_s(self) -> float | None:
        """Seconds from the alarm to the harm; None without an alarm."""
        return None if self.alarm_s is None else self.harm.harmed_at_s - self.alarm_s


@dataclass(frozen=True, slots=True)
class Coverage:
    """What a detector does at one limit: false alarms of golden flights, and its verdict on each fault.

    ``hours`` are those that the golden flights took, ``alarms`` how many of them had one.
    """

    limit: float
    flights: int
    hours: float
    alarms: int
    verdicts: tuple[FaultVerdict, ...]

    @property
    def in_time(self) -> int:
        """How many harmful faults are caught before they harm."""
        return sum(one.in_time for one in self.verdicts)


def coverage(limit: float, golden: Sequence[JudgedFlight], harmful: Sequence[JudgedFlight]) -> Coverage:
    """Count what a limit finds. ``golden`` are flights that did not set it, ``harmful`` have ``harm``."""
    return Coverage(
        limit=limit,
        flights=len(golden),
        hours=sum(one.time_s for one in golden) / SECONDS,
        alarms=sum(one.largest > limit for one in golden),
        verdicts=tuple(
            FaultVerdict(one.harm, one.first_alarm_s(limit)) for one in harmful if one.harm is not None
        ),
    )


def at_budget(flights: Sequence[JudgedFlight], per_flight: float, per_hour: float) -> Coverage:
    """The coverage at a budget of false alarms: so many a flight and so many an hour together.

    Each other golden flight sets the limit, the rest tell how many false alarms it gives.
    """
    golden = [one for one in flights if one.harm is None]
    setting, others = golden[::2], golden[1::2]
    hours = sum(one.time_s for one in setting) / SECONDS / max(len(setting), 1)
    limit = limit_within(setting, per_flight + per_hour * hours)
    return coverage(limit, others, [one for one in flights if one.harm is not None])
