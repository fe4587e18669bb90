"""What pages show of the studies of programs, computed once for all who look; and their commands."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import get_args

from dashboard.api.problems import NotFoundError
from dashboard.api.processes.program_studies import StudyEntry
from dashboard.api.routes import program_studies as api
from dashboard.api.routes.program_studies import ProgramStudyDetail, ProgramStudyLine, StudyGroup, Way
from dashboard.api.service import Service
from dashboard.web.components.frame import ask, confirmed
from dashboard.web.components.progress import Commands
from dashboard.web.components.views import MOST_CAMPAIGNS, PACE_S, SharedValue

ASKED = {
    "cancel": "Cancel {label}? What was made stays; what was not will never be.",
    "delete": "Delete {label} with all its runs? They cannot be had back.",
}

_COMMANDS: dict[str, Callable[[Service, StudyEntry], object]] = {
    "pause": api.pause_program_study,
    "resume": api.resume_program_study,
    "cancel": api.cancel_program_study,
    "delete": api.delete_program_study,
}


def entry_of(service: Service, label: str) -> StudyEntry:
    """The study that the service keeps by that label.

    :raises NotFoundError: if there is none.
    """
    entry = service.program_studies.studies.find(label)
    if entry is None:
        message = f"there is no study {label}"
        raise NotFoundError(message)
    return entry


class WatchedStudy:
    """One study, for all of its viewers.

    :raises NotFoundError: from every method, once it was deleted.
    """

    def __init__(self, service: Service, label: str) -> None:
        self._service, self._label = service, label
        self._detail = SharedValue(lambda: api.study_detail(service, entry_of(service, label)), PACE_S)
        self._groups = {way: SharedValue(self._dividing(way), PACE_S) for way in get_args(Way)}

    async def line(self) -> ProgramStudyLine:
        """The phase and the progress of the study now."""
        return await ask(lambda: api.study_line(self._service, entry_of(self._service, self._label)))

    async def detail(self, line: ProgramStudyLine) -> ProgramStudyDetail:
        """What it has found, when it stood as in ``line`` or a little earlier."""
        return await self._detail.get(line, hurry=line.phase != "running")

    async def groups(self, way: str, line: ProgramStudyLine) -> Sequence[StudyGroup]:
        """The same divided by what was struck."""
        return await self._groups[way].get(line.done, hurry=line.phase != "running")

    def _dividing(self, way: Way) -> Callable[[], Sequence[StudyGroup]]:
        def groups() -> Sequence[StudyGroup]:
            return api.read_breakdown(self._service, entry_of(self._service, self._label), way).groups

        return groups


class WatchedStudies:
    """Keeps the shared values of the studies that were shown last."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._kept: OrderedDict[str, WatchedStudy] = OrderedDict()

    def of(self, label: str) -> WatchedStudy:
        """The study of that label; whether there is one, it says itself."""
        one = self._kept.setdefault(label, WatchedStudy(self._service, label))
        self._kept.move_to_end(label)
        if len(self._kept) > MOST_CAMPAIGNS:
            self._kept.popitem(last=False)
        return one


class StudyCommands(Commands):
    """Buttons for what can be done with a study in its phase."""

    def __init__(self, service: Service, label: str, deleted: Callable[[], None]) -> None:
        self._service, self._deleted = service, deleted
        super().__init__(label, ("delete",))

    async def _act(self, name: str) -> None:
        question = ASKED.get(name)
        if question is not None and not await confirmed(
            question.format(label=self._label), name.capitalize()
        ):
            return
        entry = await ask(entry_of, self._service, self._label)
        await ask(_COMMANDS[name], self._service, entry)
        if name == "delete":
            self._deleted()


def facts_of(study: ProgramStudyDetail) -> dict[str, str]:
    """What was asked of a study, in pairs of words."""
    struck, fault = study.struck, study.struck.fault
    asked = fault.model_dump(
        exclude_defaults=True, exclude={"target", "level", "scope", "seed"}, exclude_none=True
    )
    length = study.summary.length if study.summary is not None else None
    return {
        "Command": " ".join(struck.command),
        "Struck code": " ".join(
            filter(None, (struck.module, struck.symbol, f"{struck.address:#x}" if struck.address else ""))
        )
        or "the whole run",
        "Fault": ", ".join(f"{name}={value}" for name, value in asked.items()) or "one bit of any operand",
        "Seed": str(struck.seed),
        "At a time": str(study.slots),
        "Instructions of a run": f"{length.all:,}" if length is not None and length.all else "",
        "That can be struck": f"{length.eligible:,}" if length is not None else "",
    }
