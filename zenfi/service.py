"""A service (``zenfi serve``) that flies for us: the same words as for this machine.

>>> with connect("http://127.0.0.1:8300") as service:
...     service.Campaign("demo").run().plot()
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dashboard.analysis.table import Table
from dashboard.campaigns.flight_record import FlightRecord
from dashboard.campaigns.forecast import Forecast
from dashboard.campaigns.results import export
from dashboard.campaigns.results.compare import Comparison
from dashboard.campaigns.results.summary import CellSummary
from dashboard.campaigns.spec import CampaignSpec, Cell
from dashboard.campaigns.store.listing import Phase
from dashboard.client import Client, ClosedOnExit
from dashboard.terminal.campaign_progress import CampaignProgress
from deploy.errors import InfrastructureError
from services.models.mission import MissionSpec
from services.models.outcome import Outcome
from zenfi.campaign import Campaign, FlownCampaign
from zenfi.missions import Fault, mission_of

if TYPE_CHECKING:
    from typing import Unpack

    from zenfi.mission_fields import MissionFields

POLL_S = 0.25
"""Wait before a flight is asked for again."""

_ENDED = ("done", "failed", "cancelled")


class ConnectedService(ClosedOnExit):
    """A service at an address; to be closed, or entered.

    :raises RequestRefusedError: from every method, if the service refuses.
    """

    def __init__(self, client: Client) -> None:
        self.client = client
        """Requests that have no word of their own here."""

    def close(self) -> None:
        """Close the connections to the service."""
        self.client.close()

    def fly(
        self,
        spec: MissionSpec | None = None,
        *,
        fault: Fault | None = None,
        fault_seed: int = 0,
        **fields: Unpack[MissionFields],
    ) -> Outcome:
        """Fly one mission there, as :func:`zenfi.fly` does here.

        :raises BadSpecError: if it cannot be flown.
        :raises InfrastructureError: if the service failed to fly it.
        """
        mission = mission_of(spec, fault=fault, fault_seed=fault_seed, **fields)
        flight = self.client.flights.create(mission)
        label = flight.campaign.campaign
        while flight.campaign.phase not in _ENDED:
            time.sleep(POLL_S)
            flight = self.client.flights.get(label)
        if flight.run.result is None:
            message = f"{label} was not flown: {flight.run.error or flight.campaign.reason}"
            raise InfrastructureError(message)
        return self.client.runs.outcome(label, flight.run.id)

    def Campaign(  # noqa: N802 - the word that zenfi has for it
        self,
        what: CampaignSpec | Path | str | None = None,
        /,
        *,
        scale: float = 1.0,
        arms: Mapping[str, Mapping[str, Any]] | Sequence[Any] | None = None,
        faults: Mapping[str, Fault | None] | Sequence[Any] | None = None,
        **fields: Any,
    ) -> ServiceCampaign:
        """A campaign to be flown there, given as :class:`zenfi.Campaign` is."""
        return ServiceCampaign(
            self.client, Campaign(what, scale=scale, arms=arms, faults=faults, **fields).spec
        )

    def open_campaign(self, label: str) -> ServedCampaign:
        """The campaign of that label, e.g. ``demo-1``."""
        return ServedCampaign(self.client.campaigns.get(label).campaign, self.client)

    def campaigns(self) -> list[ServedCampaign]:
        """Every campaign of the service, the oldest first."""
        return [ServedCampaign(one.campaign, self.client) for one in self.client.campaigns.all()][::-1]


class ServiceCampaign:
    """A campaign that a service is to fly."""

    def __init__(self, client: Client, spec: CampaignSpec) -> None:
        self._client = client
        self.spec = spec

    def forecast(self) -> Forecast:
        """What it takes of time and disk, and which differences it can tell."""
        return self._client.campaigns.forecast(self.spec)

    def create(self) -> ServedCampaign:
        """Have it flown, and return at once."""
        return ServedCampaign(self._client.campaigns.create(self.spec).campaign, self._client)

    def run(self, *, progress: bool = True) -> ServedCampaign:
        """Have it flown, and return when it has ended."""
        created = self.create()
        created.watch(progress=progress)
        return created


class ServedCampaign(FlownCampaign):
    """A campaign that a service has flown, or is flying."""

    def __init__(self, label: str, client: Client) -> None:
        super().__init__(label)
        self._client = client

    @property
    def spec(self) -> CampaignSpec:
        """The specification of the campaign."""
        return self._client.campaigns.get(self.label).spec

    @property
    def phase(self) -> Phase:
        """Whether it is being flown, done, paused, cancelled."""
        return self._client.campaigns.get(self.label).phase

    def fly(self, *, progress: bool = True) -> None:
        """Resume it if it is paused, and return when it has ended."""
        if self.phase == "paused":
            self._client.campaigns.command(self.label, "resume")
        self.watch(progress=progress)

    def watch(self, *, progress: bool = True) -> None:
        """Show how far it is until it has ended.

        :raises InfrastructureError: if the service does not go on with it.
        """
        now = self._client.campaigns.get(self.label)
        with CampaignProgress(self.label, now.runs, now.done + now.failed, shown=progress) as shown:
            for event in self._client.watch(self.label):
                if event.kind == "run" and event.data.result is not None:
                    shown.flown(success=event.data.result.success, proven=event.data.result.proof != "")
                elif event.kind == "run":
                    shown.failed(event.data.arm, event.data.number, event.data.error)
                elif event.kind == "campaign":
                    shown.ended(event.data.done + event.data.failed)
        now = self._client.campaigns.get(self.label)
        if now.phase == "failed":
            message = f"{self.label}: {now.trouble or now.reason}"
            raise InfrastructureError(message)

    def summary(self) -> list[CellSummary]:
        """A line per cell: success and quality of flight with 95 % intervals."""
        return self._client.campaigns.table(self.label).summary

    def table(self) -> Table:
        """A row per run, with its result if it has one."""
        records = (
            FlightRecord(
                id=run.id,
                cell=Cell(run.arm, run.world, run.fault),
                number=run.number,
                seed=run.seed,
                phase=run.phase,
                attempts=run.attempts,
                error=run.error,
                result=run.result,
            )
            for run in self._client.runs.all(self.label)
        )
        return Table.of(export.COLUMNS, export.rows(records))

    def compare(self, *, other: str | None = None, against: str | None = None) -> list[Comparison]:
        """Each cell beside its golden twins, the arm ``against``, or the cell of its name in ``other``."""
        return self._client.campaigns.comparison(self.label, other=other, against=against).comparison

    def outcomes(self) -> Iterator[Outcome]:
        """The outcome of each run that was flown or proven, in the order of the runs."""
        for run in self._client.runs.all(self.label):
            if run.result is not None:
                yield self._client.runs.outcome(self.label, run.id)


def connect(address: str = "http://127.0.0.1:8300", token: str | None = None) -> ConnectedService:
    """The service at an address; ``token`` is what ``zenfi token`` prints there.

    :raises httpx.TransportError: if none answers there, once it is asked for something.
    """
    return ConnectedService(Client(address, token))
