"""A client of the service, typed from the models that the service answers with.

::

    with Client("http://127.0.0.1:8300") as client:
        made = client.create(preset="demo")
        for event in client.watch(made.campaign):
            print(event.kind, event.data)
        print(client.table(made.campaign).summary)
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Literal, TypeVar

import httpx
from pydantic import BaseModel, TypeAdapter

from dashboard.api.again import Recorded, Series
from dashboard.api.campaigns import CampaignDetail, NewCampaign
from dashboard.api.events import FlightEvent, LostEvent, ProcessEvent, RunEvent
from dashboard.api.flights import Flight
from dashboard.api.nodes import Node, Processes
from dashboard.api.problems import MEDIA_TYPE, Problem
from dashboard.api.results import Artefact, CampaignComparison, CampaignTable
from dashboard.campaigns.forecast import Forecast
from dashboard.campaigns.listing import CampaignLine, CampaignPage, RunLine, RunPage, RunQuery, StoredRun
from dashboard.campaigns.spec import CampaignSpec
from deploy.replay import Replay
from deploy.sight import Sight
from services.bus.mission import FaultSpec, MissionSpec
from services.bus.model import Strict
from services.bus.outcome import Outcome

TIMEOUT_S = 60.0
SILENCE_S = 45.0
"""A stream that does not even ping for so long is broken."""

FLIGHT_S = 600.0
"""The longest that a flight which is flown again is waited for."""

PAUSE_S = 1.0
"""Before a broken stream is opened again."""

Told = CampaignLine | RunEvent | FlightEvent | ProcessEvent | LostEvent
_TOLD: dict[str, type[Strict]] = {
    "campaign": CampaignLine,
    "run": RunEvent,
    "flight": FlightEvent,
    "process": ProcessEvent,
    "lost": LostEvent,
}
Model = TypeVar("Model", bound=BaseModel)


class RefusedError(Exception):
    """The service has refused; ``problem`` says why."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem.detail)
        self.problem = problem


@dataclass(frozen=True, slots=True)
class Event:
    """What a stream tells; ``id`` is where to go on after it."""

    id: str
    kind: str
    data: Any


class Client:
    """Speaks with the service at ``address``.

    :raises RefusedError: from every method, if the service refuses.
    """

    def __init__(self, address: str = "http://127.0.0.1:8300", token: str | None = None) -> None:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        self._http = httpx.Client(base_url=f"{address}/api/v1", headers=headers, timeout=TIMEOUT_S)

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End every connection."""
        self._http.close()

    # -- campaigns ---------------------------------------------------------------------------------

    def create(
        self,
        spec: CampaignSpec | None = None,
        *,
        preset: str | None = None,
        scale: float = 1.0,
        request: str | None = None,
    ) -> CampaignDetail:
        """Have a campaign flown; sent again with the same ``request``, nothing new is made."""
        headers = {"Idempotency-Key": request} if request else {}
        body = NewCampaign(spec=spec, preset=preset, scale=scale).model_dump(mode="json", exclude_unset=True)
        return self._ask(CampaignDetail, "POST", "/campaigns", json=body, headers=headers)

    def forecast(self, spec: CampaignSpec) -> Forecast:
        """What a campaign would take."""
        body = {"spec": spec.model_dump(mode="json")}
        return self._ask(Forecast, "POST", "/campaigns/forecast", json=body)

    def campaigns(self) -> Iterator[CampaignLine]:
        """Every campaign, the newest first."""
        before: int | None = None
        while True:
            asked = {} if before is None else {"before": before}
            page = self._ask(CampaignPage, "GET", "/campaigns", params=asked)
            yield from page.campaigns
            before = page.next
            if before is None:
                return

    def campaign(self, label: str) -> CampaignDetail:
        """One campaign."""
        return self._ask(CampaignDetail, "GET", f"/campaigns/{label}")

    def steer(self, label: str, what: Literal["pause", "resume", "cancel", "clone"]) -> CampaignDetail:
        """Do something to a campaign; the clone, if it was cloned."""
        return self._ask(CampaignDetail, "POST", f"/campaigns/{label}/{what}")

    def delete(self, label: str) -> None:
        """Remove a campaign with all that belongs to it."""
        self._response("DELETE", f"/campaigns/{label}")

    def fly(self, mission: MissionSpec) -> Flight:
        """Have one mission flown now."""
        body = {"mission": mission.model_dump(mode="json", exclude_unset=True)}
        return self._ask(Flight, "POST", "/flights", json=body)

    def flight(self, label: str) -> Flight:
        """A single flight, and how it stands."""
        return self._ask(Flight, "GET", f"/flights/{label}")

    def sight(self, label: str) -> Sight:
        """Depth image and map of a flight that is under way."""
        return self._ask(Sight, "GET", f"/flights/{label}/sight")

    def inject(self, label: str, fault: FaultSpec) -> Flight:
        """Have a fault strike a flight that is under way; the flight in which it does."""
        body = {"fault": fault.model_dump(mode="json")}
        return self._ask(Flight, "POST", f"/flights/{label}/faults", json=body)

    # -- what was found ----------------------------------------------------------------------------

    def runs(self, label: str, query: RunQuery | None = None) -> Iterator[RunLine]:
        """Runs, page after page."""
        asked = (query or RunQuery()).model_dump(mode="json", exclude_none=True)
        while True:
            page = self._ask(RunPage, "GET", f"/campaigns/{label}/runs", params=asked)
            yield from page.runs
            if page.next is None:
                return
            asked["after"] = page.next

    def run(self, label: str, run: int) -> StoredRun:
        """One run in full."""
        return self._ask(StoredRun, "GET", f"/campaigns/{label}/runs/{run}")

    def outcome(self, label: str, run: int) -> Outcome:
        """What became of a run's mission."""
        return self._ask(Outcome, "GET", f"/campaigns/{label}/runs/{run}/outcome")

    def table(self, label: str) -> CampaignTable:
        """Quality of flight per cell, with intervals."""
        return self._ask(CampaignTable, "GET", f"/campaigns/{label}/table")

    def comparison(
        self, label: str, *, other: str | None = None, against: str | None = None
    ) -> CampaignComparison:
        """Each cell beside its reference."""
        asked = {name: value for name, value in (("other", other), ("against", against)) if value}
        return self._ask(CampaignComparison, "GET", f"/campaigns/{label}/comparison", params=asked)

    def export(self, label: str, form: Literal["csv", "parquet"] = "csv") -> bytes:
        """A row per run, as a file's content."""
        return self._response("GET", f"/campaigns/{label}/export", params={"format": form}).content

    def artefacts(self, label: str) -> list[Artefact]:
        """The files of a campaign."""
        text = self._response("GET", f"/campaigns/{label}/artefacts").content
        return TypeAdapter(list[Artefact]).validate_json(text)

    def artefact(self, label: str, path: str, first: int = 0) -> bytes:
        """A file of a campaign, from byte ``first`` on."""
        headers = {"Range": f"bytes={first}-"} if first else {}
        return self._response("GET", f"/campaigns/{label}/artefacts/{path}", headers=headers).content

    def replay(self, label: str, run: int) -> Replay:
        """Fly an injected run again and compare."""
        return self._ask(Replay, "POST", f"/campaigns/{label}/runs/{run}/replay", timeout=FLIGHT_S)

    def record_series(self, label: str, run: int) -> Series:
        """Fly a run again and keep pose and quality of flight of every tick."""
        return self._ask(Series, "POST", f"/campaigns/{label}/runs/{run}/series", timeout=FLIGHT_S)

    def series(self, label: str, run: int) -> Series:
        """The same, if it was recorded."""
        return self._ask(Series, "GET", f"/campaigns/{label}/runs/{run}/series")

    def record(self, label: str, run: int) -> Recorded:
        """Fly a run again, and its golden twin, and keep both as MCAP."""
        return self._ask(Recorded, "POST", f"/campaigns/{label}/runs/{run}/recording", timeout=FLIGHT_S)

    def recording(self, label: str, run: int, *, twin: bool = False) -> bytes:
        """A run's recording, or its golden twin's, as a file's content."""
        path = f"/campaigns/{label}/runs/{run}/recording"
        return self._response("GET", path, params={"twin": twin}).content

    # -- what runs now -----------------------------------------------------------------------------

    def processes(self) -> Processes:
        """The service with all that it has started, and the stacks that are up on its machine."""
        return self._ask(Processes, "GET", "/processes")

    def nodes(self) -> list[Node]:
        """The nodes that are on a bus now."""
        return TypeAdapter(list[Node]).validate_json(self._response("GET", "/nodes").content)

    # -- streams -----------------------------------------------------------------------------------

    def watch(self, label: str | None = None, after: str | None = None) -> Iterator[Event]:
        """What happens, in one campaign until it has ended; goes on by itself where a connection broke."""
        path = f"/campaigns/{label}/events" if label is not None else "/events"
        while True:
            try:
                for event in self._stream(path, after):
                    after = event.id
                    yield event
            except httpx.TransportError:
                time.sleep(PAUSE_S)
            else:
                if label is not None and self.campaign(label).phase in ("done", "failed", "cancelled"):
                    return
                time.sleep(PAUSE_S)

    def _stream(self, path: str, after: str | None) -> Iterator[Event]:
        headers = {"Last-Event-ID": after} if after else {}
        with self._http.stream("GET", path, headers=headers, timeout=SILENCE_S) as response:
            if response.is_error:
                response.read()
                raise _refused(response)
            fields: dict[str, str] = {}
            for line in response.iter_lines():
                name, _, value = line.partition(": ")
                if line and name:
                    fields[name] = value
                elif not line and "data" in fields:
                    kind = fields["event"]
                    yield Event(fields["id"], kind, _TOLD[kind].model_validate(json.loads(fields["data"])))
                    fields = {}

    # -- the wire ----------------------------------------------------------------------------------

    def _ask(self, model: type[Model], method: str, path: str, **request: Any) -> Model:
        return model.model_validate_json(self._response(method, path, **request).content)

    def _response(self, method: str, path: str, **request: Any) -> httpx.Response:
        response = self._http.request(method, path, **request)
        if response.is_error:
            raise _refused(response)
        return response


def _refused(response: httpx.Response) -> RefusedError:
    if response.headers.get("content-type") == MEDIA_TYPE:
        return RefusedError(Problem.model_validate_json(response.content))
    detail = f"{response.reason_phrase}: is it a service of zenfi?"
    return RefusedError(Problem(title=response.reason_phrase, status=response.status_code, detail=detail))
