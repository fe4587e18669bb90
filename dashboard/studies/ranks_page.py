"""The part of a study's page that sets kernels alone beside kernels in flight, and its table."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

from dashboard.studies.ranking import RankAgreement, RankedKernel

RANKS = "ranks.csv"

_LEGEND = (
    "Silent corruption (SDC) of the injections into a kernel alone, and harm of the flights in which a\n"
    "fault struck it: per cent with 95 % Wilson intervals. tau is Kendall's tau-b of both rankings, its\n"
    "interval from draws of the rates."
)


def sections(found: Sequence[RankAgreement]) -> Iterator[str]:
    """Heading, meaning, and for each pilot a table with the verdict on its rankings."""
    yield "## Kernels alone beside kernels in flight"
    yield _LEGEND
    for one in found:
        yield f"### {one.pilot}"
        yield "\n".join(_table(one))
        tau = "none" if one.tau is None else f"{one.tau:z.2f}"
        yield f"Kendall's tau {tau} ({one.low:z.2f} to {one.high:z.2f}): **{one.verdict}**."


def write(path: Path, found: Sequence[RankAgreement]) -> None:
    """Write a row for each pilot and kernel.

    :raises OSError: if it cannot be written.
    """
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("pilot", *RankedKernel.model_fields))
        writer.writerows(
            (one.pilot, *kernel.model_dump().values()) for one in found for kernel in one.kernels
        )


def _table(one: RankAgreement) -> Iterator[str]:
    yield "| kernel | SDC alone | of | harm in flight | of |"
    yield "|---|---|---|---|---|"
    for kernel in sorted(one.kernels, key=lambda each: -each.corrupted / each.injected):
        alone = percent(kernel.corrupted / kernel.injected, kernel.corrupted_low, kernel.corrupted_high)
        flown = percent(kernel.harmed / kernel.struck, kernel.harmed_low, kernel.harmed_high)
        yield f"| `{kernel.kernel}` | {alone} | {kernel.injected} | {flown} | {kernel.struck} |"


def percent(rate: float, low: float, high: float) -> str:
    """A rate in per cent with its interval."""
    return f"{100 * rate:.1f} ({100 * low:.1f} to {100 * high:.1f})"
