"""The paper's Fig. 6: what a bit does to each kernel alone, and what of the paper that confirms.

The paper tells Fig. 6 in words, which rank kernels by a share of their outcomes. A statement is confirmed if
it holds against each rival beyond the interval of their difference (Newcombe), with the level shared among
the rivals (Bonferroni).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

from pydantic import Field

from dashboard.analysis.kernel_study import shares
from dashboard.campaigns.statistics.proportions import newcombe, wilson
from dashboard.studies.verdict import Verdict
from injector.kernel_study.results import StudyRun
from services.kernels import PLANNERS
from services.models.base import Strict

KERNELS = ("octomap", "rrt", "rrt_connect", "rrt_star", "pid")
"""The kernels of the paper's Fig. 6."""

MOST_BENIGN_OF_OCTOMAP = 0.25
"""The paper: fewer of the faults in OctoMap are benign, and more of those in every other kernel."""

TITLE = "Fig. 6: a bit in one kernel alone"

ABOUT = (
    "What does one flipped bit do to a kernel that nothing surrounds? The paper (section IV-A): 5,000 "
    "injections a kernel; OctoMap has the most silent corruption (SDC) and less than 25 % benign, the others "
    "more; RRT* has the least silent corruption of the planners."
)

Counts = Mapping[str, int]
"""How many of a kernel's injections had each outcome."""


class KernelsAlone(Strict):
    """What is asked of the study: so many injections into each kernel, all drawn from a seed."""

    name: Literal["fig6"] = "fig6"
    kernels: tuple[str, ...] = KERNELS
    injections: int = Field(default=5000, ge=1, le=1_000_000, description="into each kernel")
    seed: int = Field(default=0, ge=0, lt=2**32)
    fault: str = Field(default="", description="what is flipped, as `zenfi kernels run --fault` has it")

    def scaled(self, factor: float) -> KernelsAlone:
        """The same with so many times the injections."""
        return self.model_copy(update={"injections": max(1, round(factor * self.injections))})


class Statement(NamedTuple):
    """What the paper says of its figure, the same of our injections, and whether they confirm it."""

    what: str
    paper: str
    ours: str
    verdict: Verdict


def counts_of(found: Mapping[str, Sequence[StudyRun]]) -> dict[str, dict[str, int]]:
    """Of each kernel: how many of the injected had each outcome."""
    return {
        kernel: {result: share.count for result, share in shares(runs).items()}
        for kernel, runs in found.items()
    }


def statements(found: Mapping[str, Counts], level: float = 0.95) -> list[Statement]:
    """What the paper says in words of its Fig. 6, beside kernels' outcomes."""
    others = [name for name in found if name != "octomap"]
    planners = [name for name in found if name in PLANNERS]
    return [
        _extreme("most silent corruption (SDC)", "octomap", found, list(found), "sdc", 1, level),
        _benign("benign in octomap", ["octomap"], found, -1, level),
        _benign("benign in the others, the smallest", others, found, 1, level),
        _extreme("least silent corruption of the planners", "rrt_star", found, planners, "sdc", -1, level),
    ]


def _extreme(
    what: str,
    claimed: str,
    found: Mapping[str, Counts],
    among: Sequence[str],
    result: str,
    sign: int,
    level: float,
) -> Statement:
    """Whether ``claimed`` has the largest (``sign`` 1) or the smallest (-1) share among kernels."""
    flown = [name for name in among if _injected(found[name])]
    if not flown:
        return Statement(what, claimed, "", "not flown")
    first = max(flown, key=lambda name: sign * _share(found[name], result))
    ours = f"{first}: {_in_words(found[first], result, level)}"
    rivals = [name for name in flown if name != claimed]
    if claimed not in flown or not rivals:
        return Statement(what, claimed, ours, "not flown")
    shared = 1 - (1 - level) / len(rivals)
    verdict: Verdict = "confirmed"
    for rival in rivals:
        pair = [found[claimed], found[rival]]
        low, high = newcombe(
            (pair[0][result], pair[1][result]), (_injected(pair[0]), _injected(pair[1])), shared
        )
        nearest, farthest = (low, high) if sign > 0 else (-high, -low)
        if farthest < 0:
            return Statement(what, claimed, ours, "not confirmed")
        if nearest <= 0:
            verdict = "not resolved"
    return Statement(what, claimed, ours, verdict)


def _benign(
    what: str, names: Sequence[str], found: Mapping[str, Counts], sign: int, level: float
) -> Statement:
    """Whether more (``sign`` 1) or fewer (-1) than the paper's part of each kernel's faults are benign."""
    paper = f"{'more' if sign > 0 else 'less'} than {100 * MOST_BENIGN_OF_OCTOMAP:.0f} %"
    flown = [name for name in names if name in found and _injected(found[name])]
    if not flown:
        return Statement(what, paper, "", "not flown")
    first = min(flown, key=lambda name: sign * _share(found[name], "benign"))
    ours = f"{first}: {_in_words(found[first], 'benign', level)}"
    verdict: Verdict = "confirmed"
    for name in flown:
        counts = found[name]
        low, high = wilson(counts["benign"], _injected(counts), 1 - (1 - level) / len(flown))
        if (high if sign > 0 else -low) < sign * MOST_BENIGN_OF_OCTOMAP:
            return Statement(what, paper, ours, "not confirmed")
        if (low if sign > 0 else -high) <= sign * MOST_BENIGN_OF_OCTOMAP:
            verdict = "not resolved"
    return Statement(what, paper, ours, verdict)


def _injected(counts: Counts) -> int:
    return sum(counts.values())


def _share(counts: Counts, result: str) -> float:
    return counts[result] / _injected(counts)


def _in_words(counts: Counts, result: str, level: float) -> str:
    low, high = wilson(counts[result], _injected(counts), level)
    return f"{100 * _share(counts, result):.1f} % ({100 * low:.1f} to {100 * high:.1f})"
