"""The paper's thesis: whether the kernels that err most alone are those whose errors harm the mission.

Kernels are ranked by their rate of silent corruption alone and by their rate of harm in flight, and both
rankings compared by Kendall's tau-b (Kendall 1945): 1 if they agree, -1 if one is the other reversed, about 0
if one says nothing of the other. Its interval is that of the rates' own: each is drawn from Jeffreys'
posterior Beta(k + 1/2, n - k + 1/2), and tau of every draw taken.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.stats import kendalltau

from dashboard.campaigns.flight_record import FlightRecord
from dashboard.campaigns.spec import CampaignSpec, mission_cells
from dashboard.campaigns.statistics.proportions import Interval, wilson
from deploy.errors import BadSpecError
from services.models.base import Strict
from services.models.faults.specification import FaultSpec

K = TypeVar("K")

DRAWS = 4000

LEAST = 3
"""Kernels: two are ranked alike in every second case."""


class KernelRate(NamedTuple):
    """How many of a kernel's faults had a result: ``found`` of ``of``."""

    found: int
    of: int

    @property
    def rate(self) -> float:
        """The part of a kernel's faults that had the result; 0 if there were none."""
        return self.found / self.of if self.of else 0.0


class RankedKernel(Strict):
    """A kernel: silent corruption of the injections alone, harm of the strikes in flight; 95 % (Wilson)."""

    kernel: str
    injected: int
    corrupted: int
    corrupted_low: float
    corrupted_high: float
    struck: int
    harmed: int
    harmed_low: float
    harmed_high: float


class RankAgreement(Strict):
    """How the ranking alone agrees with that in a pilot's flights: tau-b with its interval of 95 %.

    ``tau`` is None if all kernels have the same rate in one of both, which ranks nothing.
    """

    pilot: str
    kernels: list[RankedKernel]
    tau: float | None
    low: float
    high: float

    @property
    def verdict(self) -> str:
        """What that says of the thesis that rates alone do not tell what harms, in words."""
        if self.low > 0:
            return "kernels that err more alone harm more"
        if self.high < 0:
            return "kernels that err more alone harm less"
        return "not resolved: the interval has 0 in it"


def agreement(
    pilot: str, alone: Mapping[str, KernelRate], flown: Mapping[str, KernelRate], *, seed: int = 0
) -> RankAgreement:
    """Compare both rankings of the kernels that are in both.

    :raises BadSpecError: if these are fewer than three, or one was never struck.
    """
    names = [name for name in alone if name in flown]
    if len(names) < LEAST:
        message = f"{pilot}: {len(names)} kernels were struck both alone and in flight; ranks need {LEAST}"
        raise BadSpecError(message)
    unstruck = next((name for name in names if not (alone[name].of and flown[name].of)), None)
    if unstruck is not None:
        message = f"{pilot}: no fault struck {unstruck}; strike it more often"
        raise BadSpecError(message)
    tau, ends = rank_correlation([alone[name] for name in names], [flown[name] for name in names], seed)
    return RankAgreement(
        pilot=pilot,
        kernels=[_ranked(name, alone[name], flown[name]) for name in names],
        tau=tau,
        low=ends.low,
        high=ends.high,
    )


def rank_correlation(
    first: Sequence[KernelRate], second: Sequence[KernelRate], seed: int = 0
) -> tuple[float | None, Interval]:
    """Kendall's tau-b of two rankings of the same things (None if one ranks nothing), its 95 % interval."""
    tau = float(kendalltau([one.rate for one in first], [one.rate for one in second]).statistic)
    return None if np.isnan(tau) else tau, _interval(first, second, seed)


def agreements(
    injections: Mapping[str, Mapping[str, int]], spec: CampaignSpec, records: Sequence[FlightRecord]
) -> list[RankAgreement]:
    """Compare the ranking of kernels alone with that of each pilot's flights.

    ``injections`` says of each kernel how many had each outcome.

    :raises BadSpecError: as :func:`agreement`.
    """
    alone = {name: KernelRate(counts["sdc"], sum(counts.values())) for name, counts in injections.items()}
    return [agreement(pilot, alone, harmed) for pilot, harmed in harm_by_kernel(spec, records).items()]


def _interval(alone: Sequence[KernelRate], flown: Sequence[KernelRate], seed: int) -> Interval:
    generator = np.random.default_rng(seed)
    first, second = np.triu_indices(len(alone), 1)
    # No two drawn rates are equal, so tau-b is the mean agreement of the pairs.
    agreed = np.ones((DRAWS, len(first)))
    for tallies in (alone, flown):
        rates = _drawn(tallies, generator)
        agreed *= np.sign(rates[:, first] - rates[:, second])
    low, high = np.quantile(agreed.mean(axis=1), (0.025, 0.975))
    return Interval(float(low), float(high))


def _drawn(tallies: Sequence[KernelRate], generator: np.random.Generator) -> NDArray[np.float64]:
    """Rates (draws, kernels) that agree with what was counted."""
    found = np.array([one.found for one in tallies])
    of = np.array([one.of for one in tallies])
    return generator.beta(found + 0.5, of - found + 0.5, (DRAWS, len(tallies)))


def _ranked(kernel: str, alone: KernelRate, flown: KernelRate) -> RankedKernel:
    corrupted, harmed = wilson(*alone), wilson(*flown)
    return RankedKernel(
        kernel=kernel,
        injected=alone.of,
        corrupted=alone.found,
        corrupted_low=corrupted.low,
        corrupted_high=corrupted.high,
        struck=flown.of,
        harmed=flown.found,
        harmed_low=harmed.low,
        harmed_high=harmed.high,
    )


def harm_by_kernel(spec: CampaignSpec, records: Sequence[FlightRecord]) -> dict[str, dict[str, KernelRate]]:
    """Of each pilot: of the faults that struck each kernel's instructions, how many harmed."""
    struck: dict[str, dict[str, KernelRate]] = {}
    for (pilot, fault), rate in harm_counts(spec, records).items():
        if fault.level == "instruction":
            _add(struck.setdefault(pilot, {}), fault.target, rate)
    return struck


def harm_by_place(
    spec: CampaignSpec, records: Sequence[FlightRecord]
) -> dict[str, dict[str, dict[str, KernelRate]]]:
    """By pilot and recurrence: of the faults that were aimed at each place and struck, how many harmed."""
    struck: dict[str, dict[str, dict[str, KernelRate]]] = {}
    for (pilot, fault), rate in harm_counts(spec, records).items():
        _add(struck.setdefault(pilot, {}).setdefault(fault.recurrence, {}), fault.target, rate)
    return struck


def harm_counts(
    spec: CampaignSpec, records: Sequence[FlightRecord]
) -> dict[tuple[str, FaultSpec], KernelRate]:
    """By pilot and fault, in the order of the runs: of those that struck, how many harmed.

    Flights with a detector, and such as cannot be judged, are not counted.
    """
    struck: dict[tuple[str, FaultSpec], KernelRate] = {}
    missions = dict(mission_cells(spec))
    for one in records:
        mission, result = missions[one.cell], one.result
        if mission.fault is None or mission.detector is not None:
            continue
        if result is None or result.injection != "injected" or result.harm is None:
            continue
        _add(struck, (str(mission.pilot), mission.fault), KernelRate(int(bool(result.harm)), 1))
    return struck


def _add(rates: dict[K, KernelRate], key: K, rate: KernelRate) -> None:
    known = rates.get(key, KernelRate(0, 0))
    rates[key] = KernelRate(known.found + rate.found, known.of + rate.of)
