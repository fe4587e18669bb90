"""Faults in kernels alone, thousands of them: which crash, hang or go wrong in silence.

>>> study = zenfi.kernels.run("pid", 2000)
>>> study.summary.shares["sdc"], study.table().pandas().groupby("register").size()
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from dashboard.analysis.kernel_study import WAYS, KernelSummary, OutcomeShare, divided, summarise
from dashboard.analysis.table import Table
from deploy.config.check import check_kernel, check_machine
from deploy.config.written_faults import fault_fields
from deploy.errors import BadSpecError
from deploy.kernel_study.file import StudyFile
from deploy.kernel_study.study import Study
from deploy.kernel_study.workers import kernel_worker
from injector.kernel_study.results import StudyRun
from services.models.faults.specification import FaultSpec
from services.models.outcome import InjectionRecord

_RUN = ("kernel", "index", "result", "within_tolerance", "deviation", "cause")
_STRUCK = {
    field.alias or name: name for name, field in InjectionRecord.model_fields.items() if name != "struck"
}
"""The columns of an injection, with the attribute that each is of."""


@dataclass(frozen=True)
class KernelStudy:
    """What faults did to one kernel: a summary with intervals, and every run."""

    kernel: str
    summary: KernelSummary
    runs: list[StudyRun]

    def table(self) -> Table:
        """A row per injection: its outcome, and what was struck where."""
        rows = (
            {name: getattr(run, name) for name in _RUN}
            | {column: getattr(run.injection, name) for column, name in _STRUCK.items() if column not in _RUN}
            for run in self.runs
        )
        return Table.of(dict.fromkeys([*_RUN, *_STRUCK]), rows)

    def by(self, way: str) -> list[tuple[str, int, dict[str, OutcomeShare]]]:
        """Outcomes divided by what was struck, the most frequent first: of each its name, count and shares.

        :raises BadSpecError: if they cannot be divided so.
        """
        if way not in WAYS:
            message = f"by {way!r}: known are {', '.join(WAYS)}"
            raise BadSpecError(message)
        return list(divided(self.runs, way))


def run(
    kernel: str,
    injections: int = 1000,
    *,
    seed: int = 0,
    slots: int | None = None,
    fault: str = "",
    output: Path | str | None = None,
    progress: bool = True,
) -> KernelStudy:
    """Strike a kernel on its recorded sample so many times, so many at a time (default: one per processor).

    ``fault`` is what is flipped, e.g. ``bits=2``. ``output`` keeps the runs in a file and goes on with it.

    :raises BadSpecError: if there is no such kernel or fault, or the file holds something else.
    """
    (study,) = kernel_studies(
        [kernel], injections, seed=seed, slots=slots, fault=fault, output=output, progress=progress
    )
    return study


def kernel_studies(
    names: Sequence[str],
    injections: int,
    *,
    seed: int,
    slots: int | None,
    fault: str,
    output: Path | str | None,
    progress: bool,
) -> Iterator[KernelStudy]:
    """The studies of several kernels one after the other, in one file; see :func:`run`."""
    units = {name: check_kernel(name).unit for name in names}
    fields = fault_fields(fault)
    faults = {name: FaultSpec.model_validate({"target": name, **fields}) for name in names}
    for aimed in faults.values():
        check_machine(aimed)
    path = Path(output) if output is not None else None
    bar = Progress(console=Console(stderr=True), disable=not progress)
    with closing(StudyFile(path)) as file, bar:
        sections = {name: file.section(name, aimed, seed) for name, aimed in faults.items()}
        for name, section in sections.items():
            known = set(section.runs)
            task = bar.add_task(name, total=injections, completed=min(len(known), injections))
            begin = time.monotonic()
            study = Study(
                kernel_worker(name),
                faults[name],
                injections,
                seed,
                slots or len(os.sched_getaffinity(0)),
                section,
            )
            runs = study.run(lambda _, task=task: bar.advance(task))  # type: ignore[misc]
            made = sum(one.index not in known for one in runs)
            section.finish(runs)
            rates = made / (time.monotonic() - begin), 1e3 * study.cpu_s / made if made else 0.0
            assert section.length is not None  # noqa: S101 - the study is made
            yield KernelStudy(name, summarise(name, units[name], runs, section.length, *rates), runs)
