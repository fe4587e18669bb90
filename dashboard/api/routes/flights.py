"""Single flights on demand, and faults by hand.

A flight is a campaign of one run. A fault by hand is injected after the moment at which it was asked for: in
virtual time a flight is a function of its specification, so the flight with the fault is flown from the
beginning, is the same to the bit until then, and the one that was watched is its golden twin.
"""

from __future__ import annotations

import json

from fastapi import APIRouter, Response
from pydantic import Field

from dashboard.api.problems import NotFoundError, documented
from dashboard.api.processes.campaign_runner import is_flight
from dashboard.api.routes.campaigns import RequestKey, create
from dashboard.api.service import CampaignDep, Service, ServiceDep
from dashboard.campaigns.commands import ConflictError
from dashboard.campaigns.spec import Arm, CampaignSpec
from dashboard.campaigns.store.listing import CampaignLine, RunLine, RunQuery, line, run_page
from dashboard.campaigns.store.queries import CampaignEntry
from deploy.recording.flight_status import FlightStatus
from deploy.recording.snapshot import FlightSnapshot
from services.models.base import Strict
from services.models.faults.specification import FaultSpec, Trigger
from services.models.mission import MissionSpec

router = APIRouter(prefix="/flights", tags=["flights"], responses=documented(404, 422))


class NewFlight(Strict):
    """What to fly; with a fault, its golden twin first."""

    model_config = {"json_schema_extra": {"examples": [{"mission": {"world": "sparse", "seed": 7}}]}}

    mission: MissionSpec


class HandMadeFault(Strict):
    """A fault to inject now; its trigger is this moment."""

    model_config = {"json_schema_extra": {"examples": [{"fault": {"target": "rrt_star", "seed": 3}}]}}

    fault: FaultSpec


class FlightInfo(Strict):
    """A flight; ``present`` while it is under way."""

    campaign: CampaignLine
    run: RunLine
    present: FlightStatus | None = Field(description="as last told, a few times a second")


@router.post("", status_code=201, responses={200: {"model": FlightInfo}, **documented(413, 507)})
def create_flight(
    service: ServiceDep, new: NewFlight, response: Response, idempotency_key: RequestKey = None
) -> FlightInfo:
    """Fly a mission now: flights do not wait for campaigns, only for one another."""
    return _created(service, new.mission, response, idempotency_key)


@router.get("/{label}")
def read_flight(service: ServiceDep, campaign: CampaignDep) -> FlightInfo:
    """A single flight and its present state."""
    return _flight(service, campaign)


@router.get("/{label}/sight", responses=documented(409))
def read_sight(service: ServiceDep, campaign: CampaignDep) -> FlightSnapshot:
    """Depth image and map of a flight that is under way, renewed twice a second at most."""
    seen = service.runner.sight(_flight(service, campaign).run.id)
    if seen is None:
        message = f"{campaign.label} is not under way, or has seen nothing yet"
        raise ConflictError(message)
    return seen


@router.post("/{label}/faults", status_code=201, responses=documented(409, 413, 507))
def inject_by_hand(
    service: ServiceDep, campaign: CampaignDep, new: HandMadeFault, response: Response
) -> FlightInfo:
    """Inject a fault into a flight that is under way; answers with the flight that has the fault."""
    flight = _flight(service, campaign)
    mission = campaign.spec.mission
    if mission.clock != "lockstep" or campaign.spec.arms[0].fault is not None:
        message = f"{campaign.label}: faults by hand go with flights in lockstep that have none yet"
        raise ConflictError(message)
    if flight.present is None:
        message = f"{campaign.label} is not under way: it is {flight.campaign.phase}"
        raise ConflictError(message)
    struck = mission.model_copy(update={"fault": _from_now(new, flight.present)})
    return _created(service, struck, response, None)


def _from_now(new: HandMadeFault, present: FlightStatus) -> FaultSpec:
    """The fault with this moment: when it strikes, or from when on it recurs.

    :raises pydantic.ValidationError: if it is to end before.
    """
    fields = new.fault.model_dump(exclude={"trigger"})
    if new.fault.recurs:
        return FaultSpec.model_validate(fields | {"from_s": present.time_s})
    return FaultSpec.model_validate(fields | {"trigger": Trigger(after_ns=round(present.time_s * 1e9))})


def _created(service: Service, mission: MissionSpec, response: Response, request: str | None) -> FlightInfo:
    arm = Arm(name="flight", fault=mission.fault)
    golden = mission.model_copy(update={"fault": None})
    spec = CampaignSpec(name="flight", runs=1, mission=golden, arms=(arm,))
    made = create(service, spec, request, response)
    response.headers["Location"] = f"/api/v1/flights/{made.label}"
    return _flight(service, made)


def _flight(service: Service, campaign: CampaignEntry) -> FlightInfo:
    if not is_flight(campaign.spec):
        message = f"{campaign.label} is a campaign of many flights"
        raise NotFoundError(message)
    # Before its run, which is then at least as new: of a flight that has ended the result is there.
    state = line(service.store, service.store.find(campaign.label))
    (run,) = run_page(service.store, campaign, RunQuery()).runs
    told = [event for event in service.event_bus.newest(campaign.label) if event.kind == "flight"]
    now = FlightStatus.model_validate(json.loads(told[-1].data)["present"]) if told else None
    return FlightInfo(campaign=state, run=run, present=now)
