"""What streams tell. A line of JSON from the process that flies a campaign is one of these with its kind."""

from __future__ import annotations

from typing import Literal

from dashboard.campaigns.flight_record import Result
from dashboard.campaigns.store.listing import CampaignLine
from deploy.recording.flight_status import FlightStatus
from deploy.recording.snapshot import FlightSnapshot
from services.models.base import Strict


class RunEvent(Strict):
    """A run has ended, with a result or an error."""

    campaign: str
    run: int
    arm: str
    world: str
    fault: str
    number: int
    error: str
    result: Result | None


class FlightEvent(Strict):
    """The present state of a flight that is under way."""

    campaign: str
    run: int
    present: FlightStatus


class SightEvent(Strict):
    """What a flight sees; streams do not tell it, the runner keeps the newest."""

    campaign: str
    run: int
    sight: FlightSnapshot


class ProcessEvent(Strict):
    """A process of the service has begun or ended."""

    name: str
    pid: int
    state: Literal["running", "ended", "given up"]
    status: int | None = None


class LostEvent(Strict):
    """The client came too late for some events: None if nobody knows for how many."""

    events: int | None


class ProcessMessage(Strict):
    """What the process that flies a campaign writes, a line each."""

    kind: Literal["campaign", "run", "flight", "sight"]
    event: CampaignLine | RunEvent | FlightEvent | SightEvent
