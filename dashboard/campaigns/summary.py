"""What a campaign says: quality of flight per arm, with intervals and counted denominators."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Sequence

from scipy.stats import binomtest

from dashboard.campaigns.local import Finished
from services.bus.model import Strict
from services.kernels import aimed_at


class ArmSummary(Strict):
    """One arm. Times, distances and energies are medians over the successful flights."""

    arm: str
    runs: int
    failed_to_fly: int
    successes: int
    success_low: float
    success_high: float
    flight_time_s: float | None
    distance_m: float | None
    energy_kj: float | None
    replans: float | None
    injected: int
    results: dict[str, int]
    """Of the node that was aimed at: benign, sdc, crash, hang."""


def summarise(arms: Sequence[str], finished: Sequence[Finished]) -> list[ArmSummary]:
    """One line per arm, in the order of ``arms``."""
    return [_summary(arm, [one for one in finished if one.run.arm == arm]) for arm in arms]


def _summary(arm: str, finished: Sequence[Finished]) -> ArmSummary:
    outcomes = [one.outcome for one in finished if one.outcome is not None]
    arrived = [outcome.qof for outcome in outcomes if outcome.qof.success]
    low, high = wilson(len(arrived), len(outcomes))
    aimed = [
        outcome.nodes[aimed_at(outcome.spec.fault)].result
        for outcome in outcomes
        if outcome.spec.fault is not None
    ]
    return ArmSummary(
        arm=arm,
        runs=len(finished),
        failed_to_fly=len(finished) - len(outcomes),
        successes=len(arrived),
        success_low=low,
        success_high=high,
        flight_time_s=_median([qof.flight_time_s for qof in arrived]),
        distance_m=_median([qof.distance_m for qof in arrived]),
        energy_kj=_median([qof.energy_kj for qof in arrived]),
        replans=statistics.mean([qof.replans for qof in arrived]) if arrived else None,
        injected=sum(
            outcome.injection is not None and outcome.injection.status == "injected" for outcome in outcomes
        ),
        results=dict(sorted(Counter(aimed).items())),
    )


def _median(values: Sequence[float]) -> float | None:
    return statistics.median(values) if values else None


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """The 95 % Wilson interval of a proportion; everything is possible without trials."""
    if trials == 0:
        return 0.0, 1.0
    interval = binomtest(successes, trials).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)
