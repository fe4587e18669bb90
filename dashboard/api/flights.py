"""Single flights on demand, and faults by hand.

A flight is a campaign of one run. A fault by hand strikes after the moment at which it was asked for: in
virtual time a flight is a function of its specification, so the flight with the fault is flown from the
beginning, is the same to the bit until then, and the one that was watched is its golden twin.
"""

from __future__ import annotations

import json

from fastapi import APIRouter, Response
from pydantic import Field

from dashboard.api.campaigns import RequestKey, create
from dashboard.api.conductor import is_flight
from dashboard.api.problems import NotFoundError, documented
from dashboard.api.service import Found, Here, Service
from dashboard.campaigns.listing import CampaignLine, RunLine, RunQuery, line, run_page
from dashboard.campaigns.spec import Arm, CampaignSpec
from dashboard.campaigns.steering import ConflictError
from dashboard.campaigns.store import Campaign
from deploy.present import Present
from deploy.sight import Sight
from services.bus.mission import FaultSpec, MissionSpec, Trigger
from services.bus.model import Strict

router = APIRouter(prefix="/flights", tags=["flights"], responses=documented(404, 422))


class NewFlight(Strict):
    """What to fly; with a fault, its golden twin first."""

    model_config = {"json_schema_extra": {"examples": [{"mission": {"world": "sparse", "seed": 7}}]}}

    mission: MissionSpec


class HandMadeFault(Strict):
    """What is to strike now; its trigger is this moment."""

    model_config = {"json_schema_extra": {"examples": [{"fault": {"target": "rrt_star", "seed": 3}}]}}

    fault: FaultSpec


class Flight(Strict):
    """A flight; ``present`` while it is under way."""

    campaign: CampaignLine
    run: RunLine
    present: Present | None = Field(description="as last told, a few times a second")


@router.post("", status_code=201, responses={200: {"model": Flight}, **documented(413, 507)})
def create_flight(
    here: Here, new: NewFlight, response: Response, idempotency_key: RequestKey = None
) -> Flight:
    """Fly a mission now: flights do not wait for campaigns, only for one another."""
    return _created(here, new.mission, response, idempotency_key)


@router.get("/{label}")
def read_flight(here: Here, found: Found) -> Flight:
    """A flight, and how it stands."""
    return _flight(here, found)


@router.get("/{label}/sight")
def read_sight(here: Here, found: Found) -> Sight:
    """Depth image and map of a flight that is under way, renewed twice a second at most."""
    seen = here.conductor.sight(_flight(here, found).run.id)
    if seen is None:
        message = f"{found.label} is not under way, or has seen nothing yet"
        raise NotFoundError(message)
    return seen


@router.post("/{label}/faults", status_code=201, responses=documented(409, 413, 507))
def inject_by_hand(here: Here, found: Found, new: HandMadeFault, response: Response) -> Flight:
    """Have a fault strike a flight that is under way; answers with the flight in which it does."""
    flight = _flight(here, found)
    mission = found.spec.mission
    if mission.clock != "lockstep" or found.spec.arms[0].fault is not None:
        message = f"{found.label}: faults by hand go with flights in lockstep that have none yet"
        raise ConflictError(message)
    if flight.present is None:
        message = f"{found.label} is not under way: it is {flight.campaign.phase}"
        raise ConflictError(message)
    trigger = Trigger(after_ns=round(flight.present.time_s * 1e9))
    fault = new.fault.model_copy(update={"trigger": trigger})
    return _created(here, mission.model_copy(update={"fault": fault}), response, None)


def _created(here: Service, mission: MissionSpec, response: Response, request: str | None) -> Flight:
    arm = Arm(name="flight", fault=mission.fault)
    golden = mission.model_copy(update={"fault": None})
    spec = CampaignSpec(name="flight", runs=1, mission=golden, arms=(arm,))
    made = create(here, spec, request, response)
    response.headers["Location"] = f"/api/v1/flights/{made.label}"
    return _flight(here, made)


def _flight(here: Service, found: Campaign) -> Flight:
    if not is_flight(found.spec):
        message = f"{found.label} is a campaign of many flights"
        raise NotFoundError(message)
    (run,) = run_page(here.store, found, RunQuery()).runs
    told = [event for event in here.hub.newest(found.label) if event.kind == "flight"]
    now = Present.model_validate(json.loads(told[-1].data)["present"]) if told else None
    return Flight(campaign=line(here.store, here.store.find(found.label)), run=run, present=now)
