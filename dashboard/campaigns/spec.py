"""What is asked of a campaign: missions over seeds, in arms that differ by their fault."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from pydantic import Field, ValidationError

from deploy.check import BadSpecError, check, one_line
from deploy.definitions import inlined
from services.bus.mission import FaultSpec, MissionSpec
from services.bus.model import Strict

MAX_RUNS = 100_000


class Arm(Strict):
    """One way of flying: ``fault`` is None for golden flights. Each run draws its own fault seed."""

    name: str = Field(min_length=1, max_length=60)
    fault: FaultSpec | None = None


class CampaignSpec(Strict):
    """``runs`` flights per arm; run i flies seed ``mission.seed + i`` in every arm, so arms are paired."""

    name: str = Field(min_length=1, max_length=60, pattern=r"^[A-Za-z0-9._-]+$")
    runs: int = Field(ge=1, le=MAX_RUNS)
    mission: MissionSpec = MissionSpec()
    arms: tuple[Arm, ...] = Field(min_length=1)


@dataclass(frozen=True, slots=True)
class Run:
    """One flight of a campaign."""

    arm: str
    index: int
    spec: MissionSpec


def runs(campaign: CampaignSpec) -> Iterator[Run]:
    """Every flight of a campaign, the arms of one seed side by side so that they share its golden twin."""
    for index in range(campaign.runs):
        for arm in campaign.arms:
            fault = arm.fault
            if fault is not None:
                fault = fault.model_copy(update={"seed": fault.seed + index})
            spec = campaign.mission.model_copy(update={"seed": campaign.mission.seed + index, "fault": fault})
            yield Run(arm.name, index, spec)


def load_campaign(name: str) -> CampaignSpec:
    """The campaign in a TOML file, or the preset of that name.

    :raises BadSpecError: if there is neither, or if it is malformed; nothing is started then.
    """
    preset = files("dashboard") / "presets" / f"{name}.toml"
    path = Path(name)
    if path.suffix != ".toml" and "/" not in name and preset.is_file():
        text = preset.read_text()
    elif path.is_file():
        text = path.read_text()
    else:
        message = f"no campaign file {name!r} and no preset of that name"
        raise BadSpecError(message)
    try:
        fields = tomllib.loads(text)
        if isinstance(fields.get("mission"), dict):
            fields["mission"] = inlined(fields["mission"])
        campaign = CampaignSpec.model_validate(fields)
    except tomllib.TOMLDecodeError as error:
        message = f"{name}: not valid TOML: {error}"
        raise BadSpecError(message) from error
    except ValidationError as error:
        message = f"{name}: {one_line(error)}"
        raise BadSpecError(message) from error
    names = [arm.name for arm in campaign.arms]
    if len(set(names)) < len(names):
        message = f"{name}: arms: two arms have the same name"
        raise BadSpecError(message)
    for arm in campaign.arms:
        check(campaign.mission.model_copy(update={"fault": arm.fault}))
    return campaign
