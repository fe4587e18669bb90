"""Where the ranking of places by harm turns when a fault recurs: once beside intermittent and permanent."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from dashboard.campaigns.statistics.proportions import wilson
from dashboard.studies.ranking import LEAST, KernelRate, rank_correlation
from services.models.base import Strict

ONCE = "once"

Rates = Mapping[str, KernelRate]
"""Of the faults that struck each place, how many harmed."""


class RankTurn(Strict):
    """How the ranking of places by harm under faults that recur agrees with that of faults that strike once.

    Kendall's tau-b with its interval of 95 %; ``tau`` is None if one of both ranks nothing.
    """

    pilot: str
    recurrence: str
    places: int
    tau: float | None
    low: float
    high: float

    @property
    def verdict(self) -> str:
        """Whether the ranking of places by harm stays or turns when faults recur, in words."""
        if self.low > 0:
            return "the ranking stays"
        if self.high < 0:
            return "the ranking turns"
        return "not resolved: the interval has 0 in it"


def turns(found: Mapping[str, Mapping[str, Rates]]) -> list[RankTurn]:
    """Compare each pilot's ranking under each recurrence with that of faults that strike once.

    Only places that were struck in both ways count; of fewer than three nothing is told.
    """
    told = []
    for pilot, ways in found.items():
        once = ways.get(ONCE, {})
        for recurrence, rates in ways.items():
            places = [name for name in once if name in rates]
            if recurrence == ONCE or len(places) < LEAST:
                continue
            tau, ends = rank_correlation([once[name] for name in places], [rates[name] for name in places])
            told.append(
                RankTurn(
                    pilot=pilot,
                    recurrence=recurrence,
                    places=len(places),
                    tau=tau,
                    low=ends.low,
                    high=ends.high,
                )
            )
    return told


def sections(found: Mapping[str, Mapping[str, Rates]]) -> Iterator[str]:
    """The part of a study's page: harm of each place by recurrence, and whether its ranking turns.

    Empty if no place was struck in more ways than one.
    """
    compared = turns(found)
    if not compared:
        return
    yield "## Once, and again and again"
    yield (
        "Harm of the flights in which a fault struck a place: per cent with 95 % Wilson intervals, and of\n"
        "how many. tau is Kendall's tau-b between the ranking of places under faults that strike once and\n"
        "that under faults that recur, its interval from draws of the rates."
    )
    for pilot, ways in found.items():
        yield f"### {pilot}"
        yield "\n".join(_table(ways))
        yield "\n".join(
            f"- {one.recurrence}: tau {_tau(one)} ({one.low:z.2f} to {one.high:z.2f}), "
            f"{one.places} places: **{one.verdict}**"
            for one in compared
            if one.pilot == pilot
        )


def _table(ways: Mapping[str, Rates]) -> Iterator[str]:
    yield f"| place | {' | '.join(ways)} |"
    yield "|---|" + "---|" * len(ways)
    names = dict.fromkeys(name for rates in ways.values() for name in rates)
    for name in names:
        yield f"| `{name}` | {' | '.join(_percent(rates.get(name)) for rates in ways.values())} |"


def _percent(rate: KernelRate | None) -> str:
    if rate is None:
        return ""
    low, high = wilson(*rate)
    return f"{100 * rate.rate:.0f} ({100 * low:.0f} to {100 * high:.0f}) of {rate.of}"


def _tau(one: RankTurn) -> str:
    return "none" if one.tau is None else f"{one.tau:z.2f}"
