"""Studies of programs: which are there, how far they are, and a form that starts another one."""

from __future__ import annotations

from nicegui import ui

from dashboard.api.routes import program_studies as api
from dashboard.api.routes.program_studies import NewProgramStudy, ProgramLine, ProgramStudyLine
from dashboard.api.service import Service
from dashboard.campaigns.store.listing import LARGEST_ID
from dashboard.web.components.browser import while_in_front
from dashboard.web.components.frame import REFUSED, ask, frame, nothing, section, told, trouble
from dashboard.web.components.progress import Progress
from dashboard.web.components.study_views import StudyCommands
from deploy.config.written_faults import fault_fields
from deploy.errors import BadSpecError

AT_ONCE = 20
"""Studies a page."""

ABOUT = (
    "Faults in runs of any program, one in each run: how many crash it, hang it, or change its output in "
    "silence. Only programs that the owner of this service allows can be struck."
)


def register(service: Service) -> None:
    """Declare the page that lists the studies of programs."""

    @ui.page("/programs", response_timeout=30)
    async def page(before: int | None = None) -> None:
        older = before if before is not None and 0 <= before <= LARGEST_ID else None
        with frame("Programs"):
            ui.label(ABOUT).classes("note")
            with section("A new study"):
                _form(service)
            with section("Studies"):
                shown = _Studies(service, older)
            await shown.refresh()
            while_in_front(shown.refresh)


def _form(service: Service) -> None:
    allowed = {one.program: one for one in api.program_lines(service)}
    if not allowed:
        nothing(
            "No program may be struck.",
            "Start the service with a folder of studies: zenfi serve --programs FOLDER (docs/programs.md). "
            "At the command line: zenfi program run -- COMMAND",
        )
        return
    _Form(service, allowed)


class _Form:
    def __init__(self, service: Service, allowed: dict[str, ProgramLine]) -> None:
        self._service, self._allowed = service, allowed
        first = next(iter(allowed))
        with ui.row().classes("form"):
            self._program = ui.select(list(allowed), label="program", value=first, on_change=self._chosen)
            self._runs = ui.number("runs", min=1, max=api.MOST_RUNS, precision=0)
            self._seed = ui.number("seed", min=0, max=2**32 - 1, precision=0)
            self._fault = ui.input("fault (empty: as its file says)", placeholder="bits=2,field=exponent")
            most = allowed[first].slots
            self._slots = ui.number(f"at a time, at most {most}", value=most, min=1, max=most, precision=0)
        for one in (self._program, self._runs, self._seed, self._fault, self._slots):
            one.props("outlined")
        self._command = ui.label().classes("note command-line")
        ui.button("Start", icon="bolt", on_click=told(self._start)).props("no-caps")
        self._chosen()

    def _chosen(self) -> None:
        """Show what the file of the chosen program says."""
        line = self._allowed[str(self._program.value)]
        self._runs.set_value(line.runs)
        self._seed.set_value(line.seed)
        self._command.set_text(" ".join(line.command))

    async def _start(self) -> None:
        new = NewProgramStudy(
            program=str(self._program.value),
            runs=int(self._runs.value or 0),
            seed=int(self._seed.value or 0),
            fault=_fault(str(self._fault.value or "")),
            slots=int(self._slots.value or 0),
        )
        entry = await ask(api.create_study, self._service, new)
        ui.navigate.to(f"/programs/{entry.label}")


def _fault(text: str) -> dict[str, object] | None:
    """The fields of a fault as people write them; None if there are none.

    :raises BadSpecError: if it has not the form, or would have a file read.
    """
    if "histogram" in text:
        raise BadSpecError("fault: a histogram is named in the program's own file")
    return fault_fields(text) if text else None


class _Studies:
    def __init__(self, service: Service, before: int | None) -> None:
        self._service, self._before = service, before
        self._state = ui.column().classes("section")
        self._grid = ui.element("div").classes("cards")
        self._older = ui.row()
        self._cards: dict[str, _Card] = {}

    async def refresh(self) -> None:
        """Show where all studies of this page stand."""
        self._state.clear()
        try:
            seen = await ask(api.study_page, self._service, AT_ONCE, self._before)
        except REFUSED as error:
            with self._state:
                trouble(str(error), "What is shown below may be old. This page tries again by itself.")
            return
        if [one.study for one in seen.studies] != list(self._cards):
            self._lay_out(seen.studies, seen.next)
        for one in seen.studies:
            self._cards[one.study].show(one)
        if not seen.studies:
            with self._state:
                nothing("No studies yet.", "They appear here as soon as one is started.")

    def _lay_out(self, studies: list[ProgramStudyLine], following: int | None) -> None:
        self._grid.clear()
        with self._grid:
            self._cards = {one.study: _Card(self._service, one.study) for one in studies}
        self._older.clear()
        if following is not None:
            with self._older:
                ui.link("Older studies", f"/programs?before={following}")


class _Card:
    def __init__(self, service: Service, label: str) -> None:
        with ui.element("article").classes("card") as card:
            with ui.row().classes("card-head"):
                ui.link(label, f"/programs/{label}").classes("card-name")
                self._commands = StudyCommands(service, label, card.delete)
            self._progress = Progress("made")

    def show(self, line: ProgramStudyLine) -> None:
        """Show where the study stands."""
        self._commands.show(line.phase)
        self._progress.show_counts(line.phase, line.done, line.runs, line.reason)
