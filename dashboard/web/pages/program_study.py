"""One study of a program, live: its outcomes with intervals, what was struck, and each of its runs."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from typing import Any, get_args

from nicegui import ui

from dashboard.analysis.kernel_study import PROGRAM_RESULTS
from dashboard.api.problems import NotFoundError
from dashboard.api.routes import program_studies as api
from dashboard.api.routes.program_studies import ProgramStudyDetail, ProgramStudyLine, StudyGroup
from dashboard.api.service import Service
from dashboard.campaigns.store.listing import LARGEST_ID
from dashboard.web.charts import charts
from dashboard.web.components.breakdown import draw, fill
from dashboard.web.components.browser import while_in_front
from dashboard.web.components.frame import REFUSED, absent, ask, frame, section, told, trouble
from dashboard.web.components.injection_card import injection_card
from dashboard.web.components.outcome_shares import OutcomeGroups, counts, in_words
from dashboard.web.components.parts import facts, minute
from dashboard.web.components.progress import Progress
from dashboard.web.components.quality_tables import Row, table
from dashboard.web.components.study_views import (
    StudyCommands,
    WatchedStudies,
    WatchedStudy,
    entry_of,
    facts_of,
)
from injector.kernel_study.results import StudyResult, StudyRun
from injector.tracing.symbols import demangled

PAGE = 25
ANY = "any"
ALL_PROGRAMS = ("All studies of programs", "/programs")
OUTCOMES_NOTE = (
    "Of the injected runs, with 95 % Wilson intervals. Benign: the same output and exit status. Sdc: it "
    "ended by itself, with other output or another exit status. Not injected: never among these."
)
COLUMNS = (
    ("index", "run"),
    ("result", "outcome"),
    ("cause", "cause"),
    ("instruction", "instruction"),
    ("place", "where"),
    ("what", "what"),
    ("bits", "bits"),
    ("change", "before, after"),
)
_LINK = '<q-td :props="props"><a :href="props.row.href">{{ props.value }}</a></q-td>'


def register(service: Service) -> None:
    """Declare the pages of a study and of one of its runs."""
    studies = WatchedStudies(service)

    @ui.page("/programs/{label}", response_timeout=60)
    async def page(label: str) -> None:
        with frame(label):
            watched = studies.of(label)
            try:
                shown = StudyPage(service, label, watched, await watched.line())
            except NotFoundError:
                absent(f"There is no study {label}.", "It may have been deleted.", ALL_PROGRAMS)
                return
            await shown.refresh()
            while_in_front(shown.refresh)

    @ui.page("/programs/{label}/runs/{number}", response_timeout=30)
    async def of_run(label: str, number: int) -> None:
        with frame(f"{label}, run {number}"):
            try:
                entry = await ask(entry_of, service, label)
                run = await ask(api.reader(service, entry).run, number) if number <= LARGEST_ID else None
            except NotFoundError:
                run = None
            if run is None:
                absent(f"There is no run {number} of {label}.", "It is not made yet.", ALL_PROGRAMS)
                return
            ui.link(f"All runs of {label}", f"/programs/{label}#runs")
            with section("What came of it"):
                facts(_ending(run))
            with section("What was corrupted"):
                injection_card(run.injection)
            with section("The same again"):
                _command(service, label, f" --run {number}")


def _ending(run: StudyRun) -> dict[str, str]:
    within = "within the tolerance" if run.within_tolerance else ""
    deviation = f"{run.deviation:.3g} at most, relative" if run.deviation is not None else ""
    return {"Outcome": run.result, "Cause": run.cause, "Tolerance": within, "Deviation": deviation}


def _command(service: Service, label: str, more: str = "") -> None:
    """The command that makes runs again, on the machine of the service."""
    file = service.program_studies.studies.runs(label)
    ui.label(f"zenfi program replay {shlex.quote(str(file))}{more}").classes("log command-line")


class StudyPage:
    """The content of the page of a study."""

    def __init__(self, service: Service, label: str, watched: WatchedStudy, line: ProgramStudyLine) -> None:
        self._service, self._label, self._watched, self._line = service, label, watched, line
        self._shown: ProgramStudyDetail | None = None
        self._state = ui.column().classes("section")
        with ui.column().classes("section parts") as self._content:
            self._head()
            with section("Outcomes", OUTCOMES_NOTE), ui.element("div").classes("pair"):
                self._chart = ui.echart({}).classes("chart")
                self._outcomes = table((("outcome", "outcome"), ("runs", "runs"), ("share", "% (95 %)")))
                self._causes = table((("cause", "what differed"), ("runs", "runs")))
            with section("What was struck", anchor="struck"):
                self._groups = OutcomeGroups(self._divided)
            with section("Runs", anchor="runs"):
                self._runs = StudyRuns(service, label)
            with section("The same again", "Makes all runs again, on the machine of this service."):
                _command(service, label)

    def _head(self) -> None:
        with ui.element("article").classes("card"):
            with ui.row().classes("card-head"):
                ui.label(f"asked for at {minute(self._line.created)}").classes("note")
                ui.space()
                self._commands = StudyCommands(
                    self._service, self._label, lambda: ui.navigate.to("/programs")
                )
            self._progress = Progress("made")
            self._facts = ui.column().classes("section")
            with ui.row().classes("links"):
                path = f"/api/v1/program-studies/{self._label}"
                self._file = ui.link("runs as JSON lines", f"{path}/file").props(
                    f'download="{self._label}.jsonl"'
                )
                ui.link("all studies", "/programs")

    async def refresh(self) -> None:
        """Show where the study stands, and what it has found."""
        try:
            self._line = await self._watched.line()
            found = await self._watched.detail(self._line)
        except NotFoundError:
            self._content.set_visibility(False)
            self._tell("This study was deleted.", "The page Programs has all that there are.")
            return
        except REFUSED as error:
            self._tell(str(error), "What is shown below may be old. This page tries again by itself.")
            return
        self._state.clear()
        self._progress.show_counts(
            self._line.phase, self._line.done, self._line.runs, self._line.reason, _missed(found)
        )
        self._commands.show(self._line.phase)
        self._file.set_visibility(found.summary is not None)
        if found is not self._shown:
            self._shown = found
            self._draw(found)
            await self._groups.refresh()
            await self._runs.refresh()

    def _tell(self, what: str, remedy: str) -> None:
        self._state.clear()
        with self._state:
            trouble(what, remedy)

    def _draw(self, found: ProgramStudyDetail) -> None:
        self._facts.clear()
        with self._facts:
            facts(facts_of(found))
        shares = found.summary.shares if found.summary is not None else {}
        words = "Outcomes of the injected runs, per cent; the table beside has the numbers"
        draw(
            self._chart,
            charts.stacked([found.program], [counts(shares)], "of the injected, %", words),
            1,
        )
        told_shares = in_words(shares)
        rows: list[Row] = [
            {"outcome": name, "runs": shares[name].count, "share": told_shares[name]}
            for name in PROGRAM_RESULTS
            if name in shares
        ]
        fill(self._outcomes, rows)
        fill(self._causes, [{"cause": name, "runs": count} for name, count in found.causes.items()][:PAGE])

    async def _divided(self, way: str) -> Sequence[StudyGroup]:
        return await self._watched.groups(way, self._line)


def _missed(found: ProgramStudyDetail) -> str:
    missed = sum(found.summary.not_injected.values()) if found.summary is not None else 0
    return f", {missed} not injected" if missed else ""


class StudyRuns:
    """The runs of a study, a page at a time, of all outcomes or of one."""

    def __init__(self, service: Service, label: str) -> None:
        self._service, self._label = service, label
        self._before: list[int] = []
        self._after = -1
        self._following: int | None = None
        with ui.row().classes("filters").props('role="search"'):
            self._result = ui.select([ANY, *get_args(StudyResult)], label="outcome", value=ANY)
            self._result.props("dense outlined options-dense").classes("filter")
            self._result.on_value_change(told(self._choose))
        self._table = table(COLUMNS)
        self._table.classes("runs").add_slot("body-cell-index", _LINK)
        with ui.row().classes("toolbar"):
            self._back = ui.button("Previous", on_click=told(self._go_back)).props("flat no-caps")
            self._on = ui.button("Next", on_click=told(self._go_on)).props("flat no-caps")
            self._count = ui.label().classes("note").props('role="status"')

    async def refresh(self) -> None:
        """Show the runs of this page that are made by now."""
        after, chosen = self._after, self._result.value
        result: Any = None if chosen == ANY else chosen
        runs, following = await ask(self._read, after, result)
        if (after, chosen) != (self._after, self._result.value):
            return  # another page was turned to meanwhile
        self._following = following
        fill(self._table, [self._row(run) for run in runs])
        self._back.set_enabled(bool(self._before))
        self._on.set_enabled(following is not None)
        self._count.set_text(f"{len(runs)} runs here" if runs else "No run is like this.")

    def _read(self, after: int, result: StudyResult | None) -> tuple[list[StudyRun], int | None]:
        return api.reader(self._service, entry_of(self._service, self._label)).page(after, PAGE, result)

    async def _choose(self) -> None:
        self._before, self._after = [], -1
        await self.refresh()

    async def _go_on(self) -> None:
        if self._following is not None:
            self._before, self._after = [*self._before, self._after], self._following
            await self.refresh()

    async def _go_back(self) -> None:
        if self._before:
            *self._before, self._after = self._before
            await self.refresh()

    def _row(self, run: StudyRun) -> Row:
        record = run.injection
        memory = "memory" if record.address else ""
        place = f"{record.module}+{record.offset:#x}" if record.module else ""
        return {
            "index": run.index,
            "result": run.result,
            "cause": run.cause,
            "instruction": record.instruction,
            "place": ", ".join(filter(None, (demangled(record.symbol), place))),
            "what": f"{record.operand} {record.register_name or memory}".strip(),
            "bits": ", ".join(map(str, record.bits)),
            "change": f"{record.before} → {record.after}" if record.before else "",
            "href": f"/programs/{self._label}/runs/{run.index}",
        }
