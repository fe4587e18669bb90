"""What streams tell. A line of JSON from the process that flies a campaign is one of these with its kind."""

from __future__ import annotations

from typing import Literal

from dashboard.campaigns.listing import CampaignLine
from dashboard.campaigns.records import Result
from deploy.present import Present
from deploy.sight import Sight
from services.bus.model import Strict


class RunEvent(Strict):
    """A run has ended."""

    campaign: str
    run: int
    arm: str
    world: str
    fault: str
    number: int
    error: str
    result: Result | None


class FlightEvent(Strict):
    """How a flight stands."""

    campaign: str
    run: int
    present: Present


class SightEvent(Strict):
    """What a flight sees; streams do not tell it, the conductor keeps the newest."""

    campaign: str
    run: int
    sight: Sight


class ProcessEvent(Strict):
    """A process of the service has begun or ended."""

    name: str
    pid: int
    state: Literal["running", "ended", "given up"]
    status: int | None = None


class LostEvent(Strict):
    """The client came too late for some events: None if nobody knows for how many."""

    events: int | None


class Told(Strict):
    """What the process that flies a campaign writes, a line each."""

    kind: Literal["campaign", "run", "flight", "sight"]
    event: CampaignLine | RunEvent | FlightEvent | SightEvent
