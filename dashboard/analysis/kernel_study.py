"""What a study of a kernel or program found: shares with intervals, sizes of silent corruption, groups."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from dashboard.campaigns.statistics.proportions import wilson
from injector.kernel_study.results import CallLength, StudyResult, StudyRun
from injector.tracing.symbols import demangled
from services.models.base import Strict
from services.models.outcome import InjectionRecord

RESULTS: tuple[StudyResult, ...] = ("benign", "sdc", "crash", "hang")

PROGRAM_RESULTS: tuple[StudyResult, ...] = ("benign", "sdc", "crash", "detected", "hang")
"""A program may say by its exit status that it noticed an error."""

_CONTROL = re.compile(r"j\w+|call|ret|loop\w*|bnd")
_COMPARE = re.compile(r"cmp|test|bt|v?u?comis[sd]|v?cmp\w*|v?ptest|kortest\w*|ktest\w*")
_FLOATING = re.compile(r"v?(?!v|mov|cmp|p|u?comi|broadcast|gather)\w+[sp][sd]|v?cvt\w+|f\w+")
_VECTOR = re.compile(
    r"v\w+|p(?!ush|op|ause|refetch)\w+|mov(?:aps|apd|ups|upd|dqa|dqu|s[sd]|[hl]p[sd]|[dq]|nt\w+)|k\w+"
)
_MOVE = re.compile(
    r"mov\w*|lea|cmov\w+|xchg|set\w+|push|pop|leave|enter|c[dqw]\w+|rep\w*|stos\w|lods\w|bswap"
)


class OutcomeShare(Strict):
    """How many of the injected, and the 95 % Wilson interval of their part."""

    count: int
    low: float
    high: float


class StudySummary(Strict):
    """The outcomes of a kernel's or program's runs so far.

    ``deviations``: median, 95th percentile and maximum of the largest difference of a value, in the kernel's
    ``unit``, over silent corruption that has one (``measured``). ``length``: the call's instructions, and
    how many of them are in scope and can be struck; each of these is drawn alike.
    """

    kernel: str
    attempted: int
    injected: int
    shares: dict[str, OutcomeShare]
    tolerable_sdc: int
    unit: str
    measured: int
    deviations: tuple[float, float, float] | None
    precisions: dict[str, int]
    length: CallLength
    not_injected: dict[str, int]


class KernelSummary(StudySummary):
    """One kernel's outcomes, with rates of what was made now, not of what was kept from before."""

    per_second: float
    cpu_ms: float


class StudyTally:
    """Counts of a study's runs, by outcome, cause and what was struck; each run is added as it is made."""

    def __init__(self, results: Sequence[StudyResult] = RESULTS) -> None:
        self._results = results
        self.counts: Counter[str] = Counter()
        self.causes: Counter[tuple[str, str]] = Counter()
        """By result and cause, of runs that have one or were not injected."""
        self._precisions: Counter[str] = Counter()
        self._tolerable = 0
        self._apart: list[float] = []
        self._groups: dict[str, dict[str, Counter[str]]] = {way: defaultdict(Counter) for way in WAYS}

    def add(self, run: StudyRun) -> None:
        """Count the outcome of one more run."""
        self.counts[run.result] += 1
        if run.cause or run.result == "not_injected":
            self.causes[run.result, run.cause] += 1
        self._precisions[run.injection.precision] += 1
        self._tolerable += run.within_tolerance
        if run.deviation is not None:
            self._apart.append(run.deviation)
        if run.result in self._results:
            for way, group in WAYS.items():
                self._groups[way][group(run.injection)][run.result] += 1

    def summary(self, kernel: str, unit: str, length: CallLength) -> StudySummary:
        """The summary of the runs that were added."""
        apart = self._apart
        return StudySummary(
            kernel=kernel,
            attempted=self.counts.total(),
            injected=sum(self.counts[result] for result in self._results),
            shares=shares_of(self.counts, self._results),
            tolerable_sdc=self._tolerable,
            unit=unit,
            measured=len(apart),
            deviations=tuple(float(one) for one in np.quantile(apart, (0.5, 0.95, 1.0))) if apart else None,
            precisions=dict(self._precisions),
            length=length,
            not_injected={
                cause: count for (result, cause), count in self.causes.items() if result == "not_injected"
            },
        )

    def divided(self, way: str) -> list[tuple[str, int, dict[str, OutcomeShare]]]:
        """Groups of the injected by one of :data:`WAYS`: name, number, shares; the largest first."""
        groups = self._groups[way]
        order = sorted(groups, key=lambda name: (-groups[name].total(), name))
        return [(name, groups[name].total(), shares_of(groups[name], self._results)) for name in order]


def summarise(
    kernel: str,
    unit: str,
    runs: Sequence[StudyRun],
    length: CallLength,
    per_second: float,
    cpu_ms: float,
    results: Sequence[StudyResult] = RESULTS,
) -> KernelSummary:
    """The summary of a kernel's or program's runs."""
    told = _tally(runs, results).summary(kernel, unit, length)
    return KernelSummary(**dict(told), per_second=per_second, cpu_ms=cpu_ms)


def _tally(runs: Sequence[StudyRun], results: Sequence[StudyResult]) -> StudyTally:
    tally = StudyTally(results)
    for run in runs:
        tally.add(run)
    return tally


def shares(runs: Sequence[StudyRun], results: Sequence[StudyResult] = RESULTS) -> dict[str, OutcomeShare]:
    """Of each result among the injected."""
    return shares_of(Counter(run.result for run in runs), results)


def shares_of(found: Mapping[str, int], results: Sequence[StudyResult] = RESULTS) -> dict[str, OutcomeShare]:
    """Of each result among the injected, of which there are so many with each."""
    injected = sum(found.get(result, 0) for result in results)
    told: dict[str, OutcomeShare] = {}
    for result in results:
        count = found.get(result, 0)
        low, high = wilson(count, injected)
        told[result] = OutcomeShare(count=count, low=low, high=high)
    return told


def instruction_class(text: str) -> str:
    """What an instruction does, by its mnemonic in Intel syntax."""
    words = text.split()
    mnemonic = next((word for word in words if word not in ("lock", "bnd", "notrack")), "")
    if _CONTROL.fullmatch(mnemonic):
        return "control"
    if _COMPARE.fullmatch(mnemonic):
        return "compare"
    if _FLOATING.fullmatch(mnemonic):
        return "floating"
    if _VECTOR.fullmatch(mnemonic):
        return "vector"
    return "move" if _MOVE.fullmatch(mnemonic) else "integer"


def _bit(record: InjectionRecord) -> str:
    bits = record.bits
    return f"{bits[0] // 8 * 8}-{bits[0] // 8 * 8 + 7}" if len(bits) == 1 else f"{len(bits)} bits"


WAYS: Mapping[str, Callable[[InjectionRecord], str]] = {
    "class": lambda record: instruction_class(record.instruction),
    "register": lambda record: record.register_name or "memory or code",
    "role": lambda record: record.operand or ("named register" if record.register_name else "code"),
    "bit": _bit,
    "module": lambda record: record.module or "compiled at run time",
    "symbol": lambda record: demangled(record.symbol) or "unknown",
    "line": lambda record: record.line or "unknown",
}
"""By what injections can be divided; bits in groups of eight."""


def divided(
    runs: Sequence[StudyRun], way: str, results: Sequence[StudyResult] = RESULTS
) -> list[tuple[str, int, dict[str, OutcomeShare]]]:
    """Groups of the injected trials by what was corrupted: name, number, shares; the largest first."""
    return _tally(runs, results).divided(way)


def short_lines(lines: Sequence[str]) -> list[str]:
    """Source lines, each with as many folders of its file as tell all these files apart."""
    split = [one.split("/") for one in lines]
    files = {one.rpartition(":")[0] for one in lines}
    for parts in range(1, max(map(len, split), default=0)):
        short = ["/".join(one[-parts:]) for one in split]
        if len({one.rpartition(":")[0] for one in short}) == len(files):
            return short
    return list(lines)
