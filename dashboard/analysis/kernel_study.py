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


class KernelSummary(Strict):
    """One kernel's outcomes. Rates are of what was made now, not of what was kept from before.

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
    per_second: float
    cpu_ms: float


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
    found = Counter(run.result for run in runs)
    injected = sum(found[result] for result in results)
    apart = [run.deviation for run in runs if run.deviation is not None]
    return KernelSummary(
        kernel=kernel,
        attempted=len(runs),
        injected=injected,
        shares=shares(runs, results),
        tolerable_sdc=sum(run.within_tolerance for run in runs),
        unit=unit,
        measured=len(apart),
        deviations=tuple(float(one) for one in np.quantile(apart, (0.5, 0.95, 1.0))) if apart else None,
        precisions=dict(Counter(run.injection.precision for run in runs)),
        length=length,
        not_injected=dict(Counter(run.cause for run in runs if run.result == "not_injected")),
        per_second=per_second,
        cpu_ms=cpu_ms,
    )


def shares(runs: Sequence[StudyRun], results: Sequence[StudyResult] = RESULTS) -> dict[str, OutcomeShare]:
    """Of each result among the injected."""
    found = Counter(run.result for run in runs)
    injected = sum(found[result] for result in results)
    told: dict[str, OutcomeShare] = {}
    for result in results:
        low, high = wilson(found[result], injected)
        told[result] = OutcomeShare(count=found[result], low=low, high=high)
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
    "role": lambda record: record.operand or "code",
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
    groups: dict[str, list[StudyRun]] = defaultdict(list)
    for run in runs:
        if run.result in results:
            groups[WAYS[way](run.injection)].append(run)
    order = sorted(groups, key=lambda name: (-len(groups[name]), name))
    return [(name, len(groups[name]), shares(groups[name], results)) for name in order]


def short_lines(lines: Sequence[str]) -> list[str]:
    """Source lines, each with as many folders of its file as tell all these files apart."""
    split = [one.split("/") for one in lines]
    files = {one.rpartition(":")[0] for one in lines}
    for parts in range(1, max(map(len, split), default=0)):
        short = ["/".join(one[-parts:]) for one in split]
        if len({one.rpartition(":")[0] for one in short}) == len(files):
            return short
    return list(lines)
