"""Whether the figures of a claim come out again: all its campaigns are flown anew, in an empty store."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from dashboard.campaigns.spec import CampaignSpec, load_campaign
from dashboard.campaigns.store.store import Store
from dashboard.evidence import report
from dashboard.evidence.evidence import Evidence, gather
from deploy.errors import BadSpecError

Fly = Callable[[CampaignSpec, Path], str]
"""Fly a campaign in a store; its label there."""

_OF_A_STORE = {"label", "campaign", "replay", "replays", "flown", "proven", "runs", "budget", "zenfi"}
"""Fields that say where and how runs were made, and not what was found."""


def rebuild(folder: Path, fly: Fly) -> list[str]:
    """Fly all campaigns of a folder that ``zenfi evidence`` wrote; which figures differ, each in a line.

    :raises BadSpecError: if it is no such folder.
    """
    kept = read(folder)
    specs = [load_campaign(str(folder / report.CAMPAIGNS / f"{one.label}.json")) for one in kept.campaigns]
    with tempfile.TemporaryDirectory(prefix="zenfi-rebuild-") as place:
        labels = {one.label: fly(spec, Path(place)) for one, spec in zip(kept.campaigns, specs, strict=True)}
        elements = tuple(
            one.model_copy(update={"campaign": labels.get(one.campaign, "")}) for one in kept.budget.elements
        )
        budget = kept.budget.model_copy(update={"elements": elements})
        with closing(Store(place)) as store:
            made = gather(store, [store.find(label) for label in labels.values()], budget)
    return list(_differences("", _figures(kept), _figures(made)))


def read(folder: Path) -> Evidence:
    """Read the evidence that is kept in a folder.

    :raises BadSpecError: if there is none.
    """
    path = folder / report.DOCUMENT
    try:
        return Evidence.model_validate_json(path.read_bytes())
    except OSError as error:
        message = f"{path}: {error.strerror}"
    except ValidationError:
        message = f"{path}: no evidence; zenfi evidence LABEL --budget FILE --output DIR writes some"
    raise BadSpecError(message)


def _figures(evidence: Evidence) -> dict[str, Any]:
    told: dict[str, Any] = _without(evidence.model_dump(mode="json"))
    return told


def _without(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _without(one) for name, one in value.items() if name not in _OF_A_STORE}
    return [_without(one) for one in value] if isinstance(value, list) else value


def _differences(where: str, kept: Any, made: Any) -> Iterator[str]:
    if isinstance(kept, Mapping) and isinstance(made, Mapping):
        for name in sorted(kept.keys() | made.keys()):
            yield from _differences(f"{where}.{name}".lstrip("."), kept.get(name), made.get(name))
    elif isinstance(kept, list) and isinstance(made, list) and len(kept) == len(made):
        for number, both in enumerate(zip(kept, made, strict=True)):
            yield from _differences(f"{where}[{number}]", *both)
    elif kept != made:
        yield f"{where}: {kept} in the file, {made} now"
