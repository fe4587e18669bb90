"""Whether our flights confirm a number of the paper's, and what they are too few to tell, in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

from dashboard.campaigns.statistics.proportions import Interval
from dashboard.studies.paper import PaperValue, Records

Verdict = Literal["confirmed", "not confirmed", "not resolved", "no interval", "not flown"]
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)

MEANINGS: dict[Verdict, str] = {
    "confirmed": "our interval has the paper's value in it, and not that of no effect",
    "not confirmed": "our interval has not the paper's value in it",
    "not resolved": "our interval has both in it: more flights would tell",
    "no interval": "the longest of some flights says nothing of others",
    "not flown": "no flight says anything of it",
}


class Judged(NamedTuple):
    """A number of the paper's beside ours."""

    value: PaperValue
    ours: float | None
    interval: Interval | None
    verdict: Verdict


def judge(value: PaperValue, records: Records) -> Judged:
    """Set a number of the paper's beside that of our flights, with its interval of 95 %."""
    ours, interval = value.ours(records), value.interval(records)
    return Judged(value, ours, interval, _verdict(value, records, ours, interval))


def _verdict(value: PaperValue, records: Records, ours: float | None, interval: Interval | None) -> Verdict:
    if ours is None:
        return "not flown"
    if interval is None:
        return "no interval"
    if not interval.low <= value.paper <= interval.high:
        return "not confirmed"
    without = value.without(records)
    both = without is not None and interval.low <= without <= interval.high
    return "not resolved" if both else "confirmed"


def in_words(found: Sequence[Judged]) -> str:
    """What of the paper is confirmed, what is not, and what the flights cannot tell: a sentence each."""
    told = []
    for verdict in VERDICTS:
        names = [one.value.what for one in found if one.verdict == verdict]
        if names:
            told.append(f"**{verdict.capitalize()}** ({MEANINGS[verdict]}): {'; '.join(names)}.")
    return "\n\n".join(told)
