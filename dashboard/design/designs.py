"""All designs of a vehicle's protection, what each leaves of harm and costs, and those that none beats.

A design chooses an option for each element: nothing, a protection, or a second computer (DMR or TMR) for what
its kernel computes. What it chooses for any element is on in the whole mission, so designs that switch on the
same and have the same kernels on further computers are one. Overheads of protections add.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from math import prod

import numpy as np
from numpy.typing import NDArray

from dashboard.campaigns.statistics.proportions import clopper_pearson
from dashboard.design.overheads import ProtectionCost, RelativeOverhead, added
from dashboard.design.paired_strikes import PairedStrikes
from dashboard.design.protections import NOTHING, SCHEMES, FlownArms, combined
from dashboard.design.second_computer import SecondComputer, masking
from dashboard.evidence.budget import UpsetBudget
from dashboard.evidence.ledger import StrikeCounts, drawn_line, upsets_per_hour
from deploy.errors import BadSpecError

LIMIT = 100_000
"""Combinations of options that are evaluated; of more, options that another beats are left out first."""


@dataclass(frozen=True, slots=True)
class DesignChoice:
    """What a design has: the ``protections`` that are on, a ``scheme`` of computers or none, and its kernels.

    ``options`` is the option of each element, ``masked`` says which of them the further computers mask.
    """

    options: tuple[str, ...]
    protections: tuple[str, ...]
    scheme: str
    masked: tuple[bool, ...]

    @property
    def is_bare(self) -> bool:
        """Whether nothing is on, neither a protection nor a further computer."""
        return not self.protections and not self.scheme


@dataclass(frozen=True, slots=True)
class EvaluatedDesign:
    """A design with the strikes that stand for each element, its rate and bound, 1/h, and its costs.

    The strikes of an element that further computers mask are None. ``mass_kg`` is what the design adds.
    """

    choice: DesignChoice
    counts: tuple[StrikeCounts | None, ...]
    rate_per_hour: float
    bound_per_hour: float
    flight_time: RelativeOverhead
    energy: RelativeOverhead
    mass_kg: float

    @property
    def axes(self) -> tuple[float, float, float, float]:
        """What the front is of: bound, flight time, energy and mass; less is better of each."""
        return self.bound_per_hour, self.flight_time.mean, self.energy.mean, self.mass_kg


@dataclass(frozen=True, slots=True)
class Enumeration:
    """The designs that there are: how many ``combinations`` were looked at, and what was left out of them.

    ``pruned`` are options by element that another one of it beats, left out as there were too many
    combinations. ``impossible`` counts those of two detectors, two pilots, or DMR and TMR.
    """

    choices: tuple[DesignChoice, ...]
    combinations: int
    impossible: int
    pruned: tuple[tuple[str, str], ...]


class DesignSpace:
    """The options of each element with what is known of them: makes designs and evaluates them."""

    def __init__(
        self,
        budget: UpsetBudget,
        arms: FlownArms,
        strikes: Sequence[PairedStrikes],
        costs: Mapping[str, ProtectionCost],
        computers: Mapping[str, SecondComputer],
    ) -> None:
        self._budget, self._arms, self._strikes = budget, arms, strikes
        self._costs, self._computers = costs, computers
        self._missions = {one.name: one.mission for one in arms.protections}
        self._lines: dict[tuple[int, StrikeCounts], NDArray[np.float64]] = {}
        self._changes: dict[tuple[str, ...], dict[str, object] | None] = {}
        self.options = tuple(
            (NOTHING, *self._missions, *masking(one.fault, computers)) for one in arms.elements
        )

    def enumerate(self, limit: int = LIMIT) -> Enumeration:
        """Every design; of more combinations than ``limit``, options are left out that another beats.

        :raises BadSpecError: if there are too many even so.
        """
        options, pruned = list(self.options), []
        if _size(options) > limit:
            for number, names in enumerate(self.options):
                options[number] = tuple(self._unbeaten(number, names))
                beaten = [name for name in names if name not in options[number]]
                pruned += [(self._arms.elements[number].element.name, name) for name in beaten]
        if _size(options) > limit:
            message = (
                f"{_size(options):,} combinations of options, at most {limit:,} are evaluated: leave out "
                "elements of the budget, or campaigns"
            )
            raise BadSpecError(message)
        found: dict[tuple[object, ...], DesignChoice] = {}
        impossible = 0
        for names in product(*options):
            choice = _choice(names)
            if choice is None or self.changes(choice) is None:
                impossible += 1
            else:
                found.setdefault((choice.protections, choice.scheme, choice.masked), choice)
        return Enumeration(tuple(found.values()), _size(options), impossible, tuple(pruned))

    def changes(self, choice: DesignChoice) -> dict[str, object] | None:
        """The changes of the bare mission that fly a design; None if its protections exclude each other."""
        chosen = choice.protections
        if chosen not in self._changes:
            self._changes[chosen] = combined(self._arms.mission, [self._missions[name] for name in chosen])
        return self._changes[chosen]

    def evaluate(self, choice: DesignChoice) -> EvaluatedDesign:
        """What a design leaves of harm, by the budget's upsets, and what it costs."""
        counts = tuple(
            None if masked else strikes.counts(choice.protections)
            for strikes, masked in zip(self._strikes, choice.masked, strict=True)
        )
        open_ = [(number, one) for number, one in enumerate(counts) if one is not None]
        drawn = sum((self._drawn(number, one) for number, one in open_), np.zeros(self._budget.draws))
        costs = [self._costs[name] for name in choice.protections]
        computers = [self._computers[choice.scheme]] if choice.scheme else []
        return EvaluatedDesign(
            choice=choice,
            counts=counts,
            rate_per_hour=sum(
                upsets_per_hour(self._budget.elements[number]) * one.harmed / max(one.struck, 1)
                for number, one in open_
            ),
            bound_per_hour=float(np.quantile(drawn, self._budget.confidence)),
            flight_time=added([one.flight_time for one in costs], [one.flight_time for one in computers]),
            energy=added([one.energy for one in costs], [one.energy for one in computers]),
            mass_kg=sum(one.mass_kg for one in computers),
        )

    def _drawn(self, number: int, counts: StrikeCounts) -> NDArray[np.float64]:
        key = number, counts
        if key not in self._lines:
            self._lines[key] = drawn_line(self._budget, number, counts)
        return self._lines[key]

    def _unbeaten(self, number: int, names: Sequence[str]) -> Iterator[str]:
        """An element's options that no other one of it beats, and nothing."""
        axes = {name: self._axes(number, name) for name in names}
        for name, own in axes.items():
            if name == NOTHING or not any(_beats(other, own) for other in axes.values()):
                yield name

    def _axes(self, number: int, name: str) -> tuple[float, float, float, float]:
        if name in self._computers:
            computer = self._computers[name]
            return 0.0, computer.flight_time.mean, computer.energy.mean, computer.mass_kg
        chosen = () if name == NOTHING else (name,)
        found = self._strikes[number].counts(chosen)
        level = 2 * self._budget.confidence - 1
        costs = [self._costs[one] for one in chosen]
        return (
            clopper_pearson(found.harmed, found.struck, level).high,
            sum(one.flight_time.mean for one in costs),
            sum(one.energy.mean for one in costs),
            0.0,
        )


def front(designs: Sequence[EvaluatedDesign]) -> list[EvaluatedDesign]:
    """The designs that no other one beats, in the order of their bounds.

    Of those that are the same on all axes the one with the fewest protections stands for all.
    """
    ordered = sorted(designs, key=lambda one: (one.axes, len(one.choice.protections), one.choice.options))
    kept: list[EvaluatedDesign] = []
    axes = np.empty((0, 4))
    for one in ordered:
        own = np.array(one.axes)
        if not (axes <= own).all(axis=1).any():
            kept.append(one)
            axes = np.vstack([axes, own])
    return kept


def _choice(options: tuple[str, ...]) -> DesignChoice | None:
    schemes = {name for name in options if name in SCHEMES}
    if len(schemes) > 1:
        return None
    protections = sorted({name for name in options if name not in (NOTHING, *SCHEMES)})
    masked = tuple(name in SCHEMES for name in options)
    return DesignChoice(options, tuple(protections), next(iter(schemes), ""), masked)


def _size(options: Sequence[Sequence[str]]) -> int:
    return prod(len(names) for names in options)


def _beats(one: Sequence[float], other: Sequence[float]) -> bool:
    return one != other and all(mine <= theirs for mine, theirs in zip(one, other, strict=True))
