"""The campaigns that come along, and campaigns made larger or smaller."""

from __future__ import annotations

from importlib.resources import files
from typing import NamedTuple

from pydantic import ValidationError

from dashboard.campaigns.spec import CampaignSpec
from deploy.errors import BadSpecError, one_line


class CampaignPreset(NamedTuple):
    """What it is called, and the first line of its file."""

    name: str
    about: str


def presets() -> list[CampaignPreset]:
    """All of them, in the order of their names."""
    found = (entry for entry in (files("dashboard") / "presets").iterdir() if entry.name.endswith(".toml"))
    return sorted(
        CampaignPreset(entry.name.removesuffix(".toml"), entry.read_text().splitlines()[0].removeprefix("# "))
        for entry in found
    )


def scaled(campaign: CampaignSpec, factor: float) -> CampaignSpec:
    """The same cells with ``factor`` times the runs, seeds and looks; one run a cell at least.

    Runs of one number still fly the same seed in every cell, so flights stay paired.

    :raises BadSpecError: if there are too many then.
    """
    runs = max(1, round(campaign.runs * factor))
    fields = campaign.model_dump(exclude_unset=True) | {"runs": runs}
    if campaign.seeds is not None:
        fields["seeds"] = max(1, round(campaign.seeds * factor))
    if campaign.stop is not None:
        looks = {max(1, round(look * factor)) for look in campaign.stop.looks}
        kept = sorted(look for look in looks if look < runs)
        fields["stop"] = {**fields["stop"], "looks": kept} if kept else None
    try:
        return CampaignSpec.model_validate(fields)
    except ValidationError as error:
        message = f"scale {factor:g}: {one_line(error)}"
        raise BadSpecError(message) from error
