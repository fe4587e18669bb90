"""Requests about studies of programs, by the client of the service: see :class:`dashboard.client.Client`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from pydantic import TypeAdapter

from dashboard.api.routes.program_studies import (
    NewProgramStudy,
    ProgramLine,
    ProgramStudyDetail,
    ProgramStudyLine,
    ProgramStudyListing,
    StudyBreakdown,
    StudyRunListing,
    Way,
)
from dashboard.service_connection import ServiceConnection
from injector.kernel_study.results import StudyResult, StudyRun

_STUDIES = "/program-studies"


class ProgramStudiesClient:
    """Requests about studies of programs: start, command and remove them, read what they found."""

    def __init__(self, connection: ServiceConnection) -> None:
        self._connection = connection

    def programs(self) -> list[ProgramLine]:
        """The programs that may be struck."""
        text = self._connection.response("GET", "/programs").content
        return TypeAdapter(list[ProgramLine]).validate_json(text)

    def create(self, new: NewProgramStudy, request: str | None = None) -> ProgramStudyDetail:
        """Have runs of a program struck; sent again with the same ``request``, nothing new is made."""
        headers = {"Idempotency-Key": request} if request else {}
        body = new.model_dump(mode="json", exclude_unset=True)
        return self._connection.ask(ProgramStudyDetail, "POST", _STUDIES, json=body, headers=headers)

    def all(self, limit: int = 200) -> Iterator[ProgramStudyLine]:
        """Every study, the newest first; pages are fetched as needed."""
        asked: dict[str, int] | None = {"limit": limit}
        while asked is not None:
            page = self._connection.ask(ProgramStudyListing, "GET", _STUDIES, params=asked)
            yield from page.studies
            asked = {"limit": limit, "before": page.next} if page.next is not None else None

    def get(self, label: str) -> ProgramStudyDetail:
        """A study with its progress and its outcomes so far."""
        return self._connection.ask(ProgramStudyDetail, "GET", f"{_STUDIES}/{label}")

    def command(self, label: str, what: Literal["pause", "resume", "cancel"]) -> ProgramStudyDetail:
        """Pause, resume or cancel a study."""
        return self._connection.ask(ProgramStudyDetail, "POST", f"{_STUDIES}/{label}/{what}")

    def delete(self, label: str) -> None:
        """Remove a study with its runs."""
        self._connection.response("DELETE", f"{_STUDIES}/{label}")

    def breakdown(self, label: str, by: Way = "register") -> StudyBreakdown:
        """The outcomes divided by what was struck."""
        asked = {"by": by}
        return self._connection.ask(StudyBreakdown, "GET", f"{_STUDIES}/{label}/breakdown", params=asked)

    def runs(self, label: str, result: StudyResult | None = None, limit: int = 500) -> Iterator[StudyRun]:
        """The runs that are made, in the order of their numbers; pages are fetched as needed."""
        asked: dict[str, str | int] = {"limit": limit} | ({"result": result} if result else {})
        while True:
            page = self._connection.ask(StudyRunListing, "GET", f"{_STUDIES}/{label}/runs", params=asked)
            yield from page.runs
            if page.next is None:
                return
            asked["after"] = page.next

    def file(self, label: str) -> bytes:
        """The file of the runs, for ``zenfi program replay``."""
        return self._connection.response("GET", f"{_STUDIES}/{label}/file").content
