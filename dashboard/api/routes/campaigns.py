"""REST resource ``/campaigns``: create, command and remove campaigns."""

from __future__ import annotations

import os
from typing import Annotated, Any

from fastapi import APIRouter, Header, Query, Response
from pydantic import Field, field_validator, model_validator

from dashboard.api.problems import documented
from dashboard.api.programs import refuse_others
from dashboard.api.service import CampaignDep, Service, ServiceDep
from dashboard.campaigns import commands
from dashboard.campaigns.forecast import Forecast, forecast
from dashboard.campaigns.presets import presets, scaled
from dashboard.campaigns.spec import CampaignSpec, check_campaign, load_campaign
from dashboard.campaigns.store.listing import (
    LARGEST_ID,
    CampaignLine,
    CampaignListing,
    Files,
    campaign_page,
    files,
    line,
)
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.campaigns.store.store import RepeatedError
from deploy.errors import BadSpecError
from services.models.base import Strict

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

    model_config = {
        "json_schema_extra": {
            "examples": [_EXAMPLE, {"preset": "demo", "scale": 0.5}],
            "oneOf": [
                {
                    "required": ["spec"],
                    "properties": {
                        "spec": {"type": "object"},
                        "preset": {"type": "null"},
                        "scale": {"const": 1},
                    },
                },
                {
                    "required": ["preset"],
                    "properties": {"preset": {"type": "string"}, "spec": {"type": "null"}},
                },
            ],
        }
    }

    spec: CampaignSpec | None = None
    preset: str | None = Field(
        default=None, max_length=60, json_schema_extra={"enum": [*(one.name for one in presets()), None]}
    )
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
    """The progress of a campaign, and its specification."""

    spec: CampaignSpec
    files: dict[str, Files] = Field(description="of runs: kept, dropped, over quota")
    replays: dict[str, int] = Field(description="runs that were flown again, by the answer")
    trouble: str = Field(default="", description="why the service does not go on with it")


def detail(service: Service, campaign: CampaignEntry) -> CampaignDetail:
    """The progress of a campaign with its specification and files."""
    stands = line(service.store, service.store.find(campaign.label))
    trouble = service.runner.given_up.get(campaign.label, "")
    return CampaignDetail(
        **stands.model_dump(),
        spec=campaign.spec,
        files=files(service.store, campaign),
        replays=service.store.replay_counts(campaign),
        trouble=trouble,
    )


def admitted(service: Service, spec: CampaignSpec) -> CampaignSpec:
    """What somebody asks to be flown, checked.

    :raises ForbiddenError: if it would run a program that the owner has not named.
    :raises BadSpecError: if it cannot be flown.
    """
    refuse_others(service.programs, spec)  # first, as the check reads the programs' files
    check_campaign(spec)
    return spec


def create(service: Service, spec: CampaignSpec, request: str | None, response: Response) -> CampaignEntry:
    """Store a campaign to be flown; the one that ``request`` has made already, if it has.

    :raises BadSpecError: if it is not :func:`admitted`.
    :raises RepeatedError: if that one is another.
    """
    admitted(service, spec)
    try:
        campaign = service.store.create(spec, "fly", request)
    except RepeatedError:
        before = service.store.requested(request or "")
        if before is None or before.spec != spec:
            raise
        campaign, response.status_code = before, 200
    tell(service, campaign)
    service.runner.notify(campaign.label)
    return campaign


def tell(service: Service, campaign: CampaignEntry) -> CampaignDetail:
    """Publish the progress of a campaign to the streams and return it."""
    told = detail(service, campaign)
    event = told.model_dump_json(include=set(CampaignLine.model_fields))
    service.event_bus.publish("campaign", event, campaign.label, f"campaign {campaign.label}")
    return told


@router.post("", status_code=201, responses={200: {"model": CampaignDetail}, **documented(413, 507)})
def create_campaign(
    service: ServiceDep, new: NewCampaign, response: Response, idempotency_key: RequestKey = None
) -> CampaignDetail:
    """Store a campaign and fly it, after those that were asked for before."""
    campaign = create(service, new.made(), idempotency_key, response)
    response.headers["Location"] = f"/api/v1/campaigns/{campaign.label}"
    return detail(service, campaign)


@router.post("/forecast", responses=documented(413))
def forecast_campaign(service: ServiceDep, new: NewCampaign) -> Forecast:
    """What a campaign would take and could tell; nothing is stored."""
    return forecast(admitted(service, new.made()), service.store, len(os.sched_getaffinity(0)))


@router.get("")
def list_campaigns(
    service: ServiceDep,
    limit: Annotated[int, Query(ge=1, le=200)] = 50,
    before: Annotated[int | None, Query(ge=0, le=LARGEST_ID, description="`next` of the page before")] = None,
) -> CampaignListing:
    """Every campaign, the newest first."""
    return campaign_page(service.store, limit, before)


@router.get("/{label}")
def read_campaign(service: ServiceDep, campaign: CampaignDep) -> CampaignDetail:
    """The progress of a campaign, and its specification."""
    return detail(service, campaign)


@router.post("/{label}/pause", status_code=202, responses=documented(409))
def pause_campaign(service: ServiceDep, campaign: CampaignDep) -> CampaignDetail:
    """Have whoever flies a campaign leave it in a moment."""
    commands.pause(service.store, campaign)
    return tell(service, campaign)


@router.post("/{label}/resume", status_code=202, responses=documented(409))
def resume_campaign(service: ServiceDep, campaign: CampaignDep) -> CampaignDetail:
    """Fly what is left of a campaign, in its turn."""
    commands.refuse_ended(campaign)
    service.store.set_desired_state(campaign, "fly")
    service.runner.notify(campaign.label)
    return tell(service, campaign)


@router.post("/{label}/cancel", status_code=202, responses=documented(409))
def cancel_campaign(service: ServiceDep, campaign: CampaignDep) -> CampaignDetail:
    """Give a campaign up; what was flown stays."""
    commands.cancel(service.store, campaign)
    return tell(service, campaign)


@router.post("/{label}/clone", status_code=201, responses={200: {"model": CampaignDetail}, **documented(507)})
def clone_campaign(
    service: ServiceDep, campaign: CampaignDep, response: Response, idempotency_key: RequestKey = None
) -> CampaignDetail:
    """Fly the same again as a new campaign."""
    made = create(service, campaign.spec, idempotency_key, response)
    response.headers["Location"] = f"/api/v1/campaigns/{made.label}"
    return detail(service, made)


@router.delete("/{label}", status_code=204, responses=documented(409))
def delete_campaign(service: ServiceDep, campaign: CampaignDep) -> None:
    """Remove a campaign with all its runs, results and files; refused while it is flown."""
    service.store.delete(campaign)
    service.runner.given_up.pop(campaign.label, None)
    service.event_bus.forget(f"campaign {campaign.label}")
