"""What the study of kernels alone leaves in a folder: page, tables, figure, injections and specification."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from dashboard.analysis import plots
from dashboard.analysis.kernel_study import RESULTS, KernelSummary, OutcomeShare, divided
from dashboard.studies.folder import FIGURE, PAGE, machine
from dashboard.studies.kernels_alone import ABOUT, TITLE, KernelsAlone, Statement, counts_of, statements
from dashboard.studies.verdict import Verdict
from deploy.errors import BadSpecError
from injector.kernel_study.results import StudyRun

INJECTIONS, OUTCOMES, SPEC = "injections.jsonl", "outcomes.csv", "kernels.json"
"""The injections, by which an interrupted study goes on; the table; what makes the page again."""

_LEGEND = (
    "Per cent of the injected with 95 % Wilson intervals. Each dynamic instruction of the call in which a\n"
    "bit can be flipped is drawn alike; every flip was read back."
)

_WAYS = ("class", "bit")

_LARGEST = 6
"""Groups that are shown of each kernel."""

_MEANINGS: dict[Verdict, str] = {
    "confirmed": "it holds beyond the intervals",
    "not confirmed": "the opposite holds beyond the intervals",
    "not resolved": "the intervals leave both open: more injections would tell",
    "not flown": "no injection says anything of it",
}


class StudiedKernel(NamedTuple):
    """A kernel's outcomes and every injection."""

    summary: KernelSummary
    runs: Sequence[StudyRun]


def write(folder: Path, asked: KernelsAlone, found: Sequence[StudiedKernel]) -> None:
    """Write the page, its table and its figure into a folder, which is there.

    :raises BadSpecError: if it cannot be written, or matplotlib is not installed.
    """
    try:
        _write_outcomes(folder / OUTCOMES, found)
        figure = plots.outcomes(TITLE, {one.summary.kernel: one.summary.shares for one in found})
        (folder / FIGURE).write_text(plots.svg(figure))
        (folder / SPEC).write_text(asked.model_dump_json(indent=1) + "\n")
        (folder / PAGE).write_text(page(asked, found))
    except OSError as error:
        message = f"{folder}: {error.strerror}"
        raise BadSpecError(message) from error


def page(asked: KernelsAlone, found: Sequence[StudiedKernel]) -> str:
    """The page: what was asked and made, the paper's statements beside ours, all outcomes."""
    judged = statements(counts_of({one.summary.kernel: one.runs for one in found}))
    parts = [
        f"# {TITLE}" + (f" ({asked.fault})" if asked.fault else ""),
        ABOUT,
        _made(asked, found),
        f"![outcomes of each kernel]({FIGURE})",
        "## The paper's statements beside ours",
        "\n".join(_claimed(judged)),
        _in_words(judged),
        "## Outcomes",
        _LEGEND,
        "\n".join(_outcomes(found)),
    ]
    for way in _WAYS:
        parts += [
            f"## By {way}",
            f"The {_LARGEST} largest groups of each kernel.",
            "\n".join(_by(way, found)),
        ]
    return "\n\n".join(parts) + "\n"


def _made(asked: KernelsAlone, found: Sequence[StudiedKernel]) -> str:
    injected = sum(one.summary.injected for one in found)
    attempted = sum(one.summary.attempted for one in found)
    about = (
        f"{asked.injections:,} injections into each of {len(found)} kernels, drawn from "
        f"seed {asked.seed}; "
        f"{injected:,} of {attempted:,} struck, on {machine()}."
    )
    again = f"zenfi study run {SPEC}  # this page again"
    if asked == KernelsAlone():
        again = f"zenfi study run {asked.name}\n{again}"
    return f"{about}\n\n```\n{again}\n```"


def _claimed(judged: Sequence[Statement]) -> Iterator[str]:
    yield "| | paper | ours (95 %) | |"
    yield "|---|---|---|---|"
    for one in judged:
        yield f"| {one.what} | {one.paper} | {one.ours} | {one.verdict} |"


def _in_words(judged: Sequence[Statement]) -> str:
    told = []
    for verdict, meaning in _MEANINGS.items():
        names = [one.what for one in judged if one.verdict == verdict]
        if names:
            told.append(f"**{verdict.capitalize()}** ({meaning}): {'; '.join(names)}.")
    return "\n\n".join(told)


def _outcomes(found: Sequence[StudiedKernel]) -> Iterator[str]:
    yield f"| kernel | injected | {' | '.join(RESULTS)} | SDC within tolerance | not injected |"
    yield "|---|" + "---|" * (len(RESULTS) + 3)
    for summary, _ in found:
        cells = _cells(summary.shares)
        missed = sum(summary.not_injected.values())
        tail = f"{summary.tolerable_sdc} | {missed}"
        yield f"| `{summary.kernel}` | {summary.injected} | {' | '.join(cells)} | {tail} |"


def _by(way: str, found: Sequence[StudiedKernel]) -> Iterator[str]:
    yield f"| kernel | {way} | injected | {' | '.join(RESULTS)} |"
    yield "|---|---|---|" + "---|" * len(RESULTS)
    for summary, runs in found:
        for group, count, shares in divided(runs, way)[:_LARGEST]:
            yield f"| `{summary.kernel}` | {group} | {count} | {' | '.join(_cells(shares))} |"


def _cells(shares: dict[str, OutcomeShare]) -> list[str]:
    total = max(sum(one.count for one in shares.values()), 1)
    return [
        f"{100 * one.count / total:.1f} ({100 * one.low:.1f} to {100 * one.high:.1f})"
        for one in shares.values()
    ]


def _write_outcomes(path: Path, found: Sequence[StudiedKernel]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("kernel", "outcome", "count", "injected", "low", "high"))
        for summary, _ in found:
            for name, one in summary.shares.items():
                writer.writerow((summary.kernel, name, one.count, summary.injected, one.low, one.high))
