"""Campaigns: made, steered, removed."""

from __future__ import annotations

import os
from typing import Annotated, Any

from fastapi import APIRouter, Header, Query, Response
from pydantic import Field, field_validator, model_validator

from dashboard.api.problems import documented
from dashboard.api.programs import refuse_others
from dashboard.api.service import Found, Here, Service
from dashboard.campaigns import steering
from dashboard.campaigns.forecast import Forecast, forecast
from dashboard.campaigns.listing import (
    LARGEST_ID,
    CampaignLine,
    CampaignPage,
    Files,
    campaign_page,
    files,
    line,
)
from dashboard.campaigns.presets import presets, scaled
from dashboard.campaigns.spec import CampaignSpec, check_campaign, load_campaign
from dashboard.campaigns.store import Campaign, RepeatedError
from deploy.check import BadSpecError
from services.bus.model import Strict

router = APIRouter(prefix="/campaigns", tags=["campaigns"], responses=documented(404, 422))

_EXAMPLE: dict[str, Any] = {
    "spec": {
        "name": "planners",
        "runs": 4,
        "mission": {"world": "sparse"},
        "arms": [{"name": "golden"}, {"name": "rrt_star", "fault": {"target": "rrt_star"}}],
    }
}

RequestKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=200,
        description="A request that is sent again with the same key makes nothing new.",
    ),
]


class NewCampaign(Strict):
    """A specification, or a preset's name."""

    model_config = {"json_schema_extra": {"examples": [_EXAMPLE, {"preset": "demo", "scale": 0.5}]}}

    spec: CampaignSpec | None = None
    preset: str | None = Field(default=None, max_length=60)
    scale: float = Field(default=1.0, gt=0, le=1000, description="times the runs of the preset")

    @field_validator("spec")
    @classmethod
    def _flown_here(cls, spec: CampaignSpec | None) -> CampaignSpec | None:
        # Else whoever may ask could have this machine connect to others, and write into folders.
        if spec is not None and spec.executor.kind != "local":
            message = f"executor: {spec.executor.kind!r} is for zenfi campaign run; here it is 'local'"
            raise ValueError(message)
        return spec

    @model_validator(mode="after")
    def _one_of_two(self) -> NewCampaign:
        if (self.spec is None) == (self.preset is None):
            raise ValueError("spec, preset: exactly one of them")
        if self.spec is not None and self.scale != 1.0:
            raise ValueError("scale: goes with a preset")
        return self

    def made(self) -> CampaignSpec:
        """The specification, yet to be :func:`admitted`.

        :raises BadSpecError: if there is no such preset.
        """
        if self.spec is not None:
            return self.spec
        known = [one.name for one in presets()]
        if self.preset not in known:
            message = f"preset: unknown {self.preset!r}; known: {', '.join(known)}"
            raise BadSpecError(message)
        return scaled(load_campaign(self.preset), self.scale)


class CampaignDetail(CampaignLine):
    """Where a campaign stands, and what was asked."""

    spec: CampaignSpec
    files: dict[str, Files] = Field(description="of runs: kept, dropped, over quota")
    trouble: str = Field(default="", description="why the service does not go on with it")


def detail(here: Service, found: Campaign) -> CampaignDetail:
    """A campaign in full."""
    stands = line(here.store, here.store.find(found.label))
    trouble = here.conductor.given_up.get(found.label, "")
    kept = files(here.store, found)
    return CampaignDetail(**stands.model_dump(), spec=found.spec, files=kept, trouble=trouble)


def admitted(here: Service, spec: CampaignSpec) -> CampaignSpec:
    """What somebody asks to be flown, checked.

    :raises ForbiddenError: if it would run a program that the owner has not named.
    :raises BadSpecError: if it cannot be flown.
    """
    refuse_others(here.programs, spec)  # first, as the check reads the programs' files
    check_campaign(spec)
    return spec


def create(here: Service, spec: CampaignSpec, request: str | None, response: Response) -> Campaign:
    """Store a campaign to be flown; the one that ``request`` has made already, if it has.

    :raises BadSpecError: if it is not :func:`admitted`.
    :raises RepeatedError: if that one is another.
    """
    admitted(here, spec)
    try:
        found = here.store.create(spec, "fly", request)
    except RepeatedError:
        before = here.store.requested(request or "")
        if before is None or before.spec != spec:
            raise
        found, response.status_code = before, 200
    tell(here, found)
    here.conductor.knock(found.label)
    return found


def tell(here: Service, found: Campaign) -> CampaignDetail:
    """Have streams tell where a campaign stands, and answer with it."""
    told = detail(here, found)
    event = told.model_dump_json(include=set(CampaignLine.model_fields))
    here.hub.publish("campaign", event, found.label, f"campaign {found.label}")
    return told


@router.post("", status_code=201, responses={200: {"model": CampaignDetail}, **documented(413, 507)})
def create_campaign(
    here: Here, new: NewCampaign, response: Response, idempotency_key: RequestKey = None
) -> CampaignDetail:
    """Store a campaign and fly it, after those that were asked for before."""
    found = create(here, new.made(), idempotency_key, response)
    response.headers["Location"] = f"/api/v1/campaigns/{found.label}"
    return detail(here, found)


@router.post("/forecast", responses=documented(413))
def forecast_campaign(here: Here, new: NewCampaign) -> Forecast:
    """What a campaign would take and could tell; nothing is stored."""
    return forecast(admitted(here, new.made()), here.store, len(os.sched_getaffinity(0)))


@router.get("")
def list_campaigns(
    here: Here,
    limit: Annotated[int, Query(ge=1, le=200)] = 50,
    before: Annotated[int | None, Query(ge=0, le=LARGEST_ID, description="`next` of the page before")] = None,
) -> CampaignPage:
    """Every campaign, the newest first."""
    return campaign_page(here.store, limit, before)


@router.get("/{label}")
def read_campaign(here: Here, found: Found) -> CampaignDetail:
    """Where a campaign stands, and what was asked."""
    return detail(here, found)


@router.post("/{label}/pause", status_code=202, responses=documented(409))
def pause_campaign(here: Here, found: Found) -> CampaignDetail:
    """Have whoever flies a campaign leave it in a moment."""
    steering.pause(here.store, found)
    return tell(here, found)


@router.post("/{label}/resume", status_code=202, responses=documented(409))
def resume_campaign(here: Here, found: Found) -> CampaignDetail:
    """Fly what is left of a campaign, in its turn."""
    steering.refuse_ended(found)
    here.store.wish(found, "fly")
    here.conductor.knock(found.label)
    return tell(here, found)


@router.post("/{label}/cancel", status_code=202, responses=documented(409))
def cancel_campaign(here: Here, found: Found) -> CampaignDetail:
    """Give a campaign up; what was flown stays."""
    steering.cancel(here.store, found)
    return tell(here, found)


@router.post("/{label}/clone", status_code=201, responses={200: {"model": CampaignDetail}, **documented(507)})
def clone_campaign(
    here: Here, found: Found, response: Response, idempotency_key: RequestKey = None
) -> CampaignDetail:
    """Fly the same again as a new campaign."""
    made = create(here, found.spec, idempotency_key, response)
    response.headers["Location"] = f"/api/v1/campaigns/{made.label}"
    return detail(here, made)


@router.delete("/{label}", status_code=204, responses=documented(409))
def delete_campaign(here: Here, found: Found) -> None:
    """Remove a campaign with all its runs, results and files; refused while it is flown."""
    here.store.delete(found)
    here.conductor.given_up.pop(found.label, None)
    here.hub.forget(f"campaign {found.label}")
