"""A client of the service, typed from the models that the service answers with.

::

    with Client("http://127.0.0.1:8300") as client:
        made = client.campaigns.create(preset="demo")
        for event in client.watch(made.campaign):
            print(event.kind, event.data)
        print(client.campaigns.table(made.campaign).summary)
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from types import TracebackType
from typing import Literal, Self

import httpx
from pydantic import TypeAdapter

from dashboard.api.processes.rerun_process import FlightSeries, RecordedFlight
from dashboard.api.routes.campaigns import CampaignDetail, NewCampaign
from dashboard.api.routes.flights import FlightInfo
from dashboard.api.routes.nodes import NodeInfo, ProcessList
from dashboard.api.routes.results import Artefact, CampaignComparison, CampaignTable
from dashboard.campaigns.forecast import Forecast
from dashboard.campaigns.spec import CampaignSpec
from dashboard.campaigns.store.listing import (
    CampaignLine,
    CampaignListing,
    RunLine,
    RunListing,
    RunQuery,
    StoredRun,
)
from dashboard.program_studies_client import ProgramStudiesClient
from dashboard.service_connection import PAUSE_S, RequestRefusedError, ServiceConnection, StreamEvent
from deploy.pairing.replay import Replay
from deploy.recording.snapshot import FlightSnapshot
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec
from services.models.outcome import Outcome

__all__ = ["CampaignsClient", "Client", "ClosedOnExit", "FlightsClient", "RequestRefusedError", "RunsClient"]

FLIGHT_S = 600.0
"""Longest wait for a run that is flown again."""


class CampaignsClient:
    """Requests about campaigns: create, command and remove them, read what they found."""

    def __init__(self, connection: ServiceConnection) -> None:
        self._connection = connection

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
        return self._connection.ask(CampaignDetail, "POST", "/campaigns", json=body, headers=headers)

    def forecast(self, spec: CampaignSpec) -> Forecast:
        """Estimate the time, disk space and precision of a campaign."""
        body = {"spec": spec.model_dump(mode="json")}
        return self._connection.ask(Forecast, "POST", "/campaigns/forecast", json=body)

    def all(self) -> Iterator[CampaignLine]:
        """Every campaign, the newest first; pages are fetched as needed."""
        before: int | None = None
        while True:
            asked = {} if before is None else {"before": before}
            page = self._connection.ask(CampaignListing, "GET", "/campaigns", params=asked)
            yield from page.campaigns
            before = page.next
            if before is None:
                return

    def get(self, label: str) -> CampaignDetail:
        """A campaign with its specification and its progress."""
        return self._connection.ask(CampaignDetail, "GET", f"/campaigns/{label}")

    def command(self, label: str, what: Literal["pause", "resume", "cancel", "clone"]) -> CampaignDetail:
        """Pause, resume, cancel or clone a campaign; answers with it, or with its clone."""
        return self._connection.ask(CampaignDetail, "POST", f"/campaigns/{label}/{what}")

    def delete(self, label: str) -> None:
        """Remove a campaign with its runs, results and files."""
        self._connection.response("DELETE", f"/campaigns/{label}")

    def table(self, label: str) -> CampaignTable:
        """Quality of flight per cell, with intervals."""
        return self._connection.ask(CampaignTable, "GET", f"/campaigns/{label}/table")

    def comparison(
        self, label: str, *, other: str | None = None, against: str | None = None
    ) -> CampaignComparison:
        """Compare each cell with its reference: its golden twins, an arm, or another campaign."""
        asked = {name: value for name, value in (("other", other), ("against", against)) if value}
        return self._connection.ask(CampaignComparison, "GET", f"/campaigns/{label}/comparison", params=asked)

    def export(self, label: str, form: Literal["csv", "parquet"] = "csv") -> bytes:
        """The content of a file with a row for each run."""
        return self._connection.response("GET", f"/campaigns/{label}/export", params={"format": form}).content

    def artefacts(self, label: str) -> list[Artefact]:
        """List the files of a campaign."""
        text = self._connection.response("GET", f"/campaigns/{label}/artefacts").content
        return TypeAdapter(list[Artefact]).validate_json(text)

    def artefact(self, label: str, path: str, first: int = 0) -> bytes:
        """The content of a file of a campaign, from byte ``first`` on."""
        headers = {"Range": f"bytes={first}-"} if first else {}
        return self._connection.response(
            "GET", f"/campaigns/{label}/artefacts/{path}", headers=headers
        ).content


class RunsClient:
    """Requests about the runs of a campaign: read, replay and record them."""

    def __init__(self, connection: ServiceConnection) -> None:
        self._connection = connection

    def all(self, label: str, query: RunQuery | None = None) -> Iterator[RunLine]:
        """The runs of a campaign that match ``query``; pages are fetched as needed."""
        asked = (query or RunQuery()).model_dump(mode="json", exclude_none=True)
        while True:
            page = self._connection.ask(RunListing, "GET", f"/campaigns/{label}/runs", params=asked)
            yield from page.runs
            if page.next is None:
                return
            asked["after"] = page.next

    def get(self, label: str, run: int) -> StoredRun:
        """A run with its specification and outcome."""
        return self._connection.ask(StoredRun, "GET", f"/campaigns/{label}/runs/{run}")

    def outcome(self, label: str, run: int) -> Outcome:
        """The outcome of a run's mission."""
        return self._connection.ask(Outcome, "GET", f"/campaigns/{label}/runs/{run}/outcome")

    def replay(self, label: str, run: int) -> Replay:
        """Fly an injected run again and compare its outcome with the stored one."""
        return self._connection.ask(Replay, "POST", f"/campaigns/{label}/runs/{run}/replay", timeout=FLIGHT_S)

    def record_series(self, label: str, run: int) -> FlightSeries:
        """Fly a run again and keep pose and quality of flight of every tick."""
        return self._connection.ask(
            FlightSeries, "POST", f"/campaigns/{label}/runs/{run}/series", timeout=FLIGHT_S
        )

    def series(self, label: str, run: int) -> FlightSeries:
        """Pose and quality of flight of every tick, if :meth:`record_series` has kept them."""
        return self._connection.ask(FlightSeries, "GET", f"/campaigns/{label}/runs/{run}/series")

    def record(self, label: str, run: int) -> RecordedFlight:
        """Fly a run again, and its golden twin, and keep both as MCAP."""
        return self._connection.ask(
            RecordedFlight, "POST", f"/campaigns/{label}/runs/{run}/recording", timeout=FLIGHT_S
        )

    def recording(self, label: str, run: int, *, twin: bool = False) -> bytes:
        """A run's recording, or its golden twin's, as a file's content."""
        path = f"/campaigns/{label}/runs/{run}/recording"
        return self._connection.response("GET", path, params={"twin": twin}).content


class FlightsClient:
    """Requests about single flights: start, read and inject faults into them."""

    def __init__(self, connection: ServiceConnection) -> None:
        self._connection = connection

    def create(self, mission: MissionSpec) -> FlightInfo:
        """Fly one mission now, without waiting for campaigns."""
        body = {"mission": mission.model_dump(mode="json", exclude_unset=True)}
        return self._connection.ask(FlightInfo, "POST", "/flights", json=body)

    def get(self, label: str) -> FlightInfo:
        """A single flight and its present state."""
        return self._connection.ask(FlightInfo, "GET", f"/flights/{label}")

    def sight(self, label: str) -> FlightSnapshot:
        """Depth image and map of a flight that is under way."""
        return self._connection.ask(FlightSnapshot, "GET", f"/flights/{label}/sight")

    def inject(self, label: str, fault: FaultSpec) -> FlightInfo:
        """Inject a fault into a flight that is under way; answers with the flight that has the fault."""
        body = {"fault": fault.model_dump(mode="json")}
        return self._connection.ask(FlightInfo, "POST", f"/flights/{label}/faults", json=body)


class ClosedOnExit(ABC):
    """Something that is closed when a ``with`` block is left."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @abstractmethod
    def close(self) -> None:
        """Close the connection to the service and whatever else it holds."""


class Client(ClosedOnExit):
    """A client of the service at ``address``; its attributes have the methods of each resource.

    :raises RequestRefusedError: from every method, if the service answers with an error.
    """

    def __init__(self, address: str = "http://127.0.0.1:8300", token: str | None = None) -> None:
        self._connection = ServiceConnection(address, token)
        self.campaigns = CampaignsClient(self._connection)
        self.runs = RunsClient(self._connection)
        self.flights = FlightsClient(self._connection)
        self.program_studies = ProgramStudiesClient(self._connection)

    def close(self) -> None:
        """Close the connections to the service."""
        self._connection.close()

    def processes(self) -> ProcessList:
        """The service with all that it has started, and the stacks that are up on its machine."""
        return self._connection.ask(ProcessList, "GET", "/processes")

    def nodes(self) -> list[NodeInfo]:
        """The nodes that are on a bus of the service now."""
        return TypeAdapter(list[NodeInfo]).validate_json(self._connection.response("GET", "/nodes").content)

    def watch(self, label: str | None = None, after: str | None = None) -> Iterator[StreamEvent]:
        """Events as they happen; of one campaign, until it has ended. Reconnects where a connection broke."""
        path = f"/campaigns/{label}/events" if label is not None else "/events"
        while True:
            try:
                for event in self._connection.stream(path, after):
                    after = event.id
                    yield event
            except httpx.TransportError:
                time.sleep(PAUSE_S)
            else:
                if label is not None and self.campaigns.get(label).phase in ("done", "failed", "cancelled"):
                    return
                time.sleep(PAUSE_S)
