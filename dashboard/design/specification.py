"""The campaign that flies a design: all that it has on, under its elements' faults, on new seeds."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from dashboard.campaigns.spec import Arm, CampaignSpec, Condition
from dashboard.design.protections import ProtectedElement
from services.models.mission import MissionSpec


def fault_name(number: int, element: str) -> str:
    """What the fault of the element of that number is called in a design's campaign; each is another one."""
    return f"{number + 1} {element}"[:60].rstrip()


def design_campaign(
    name: str,
    mission: MissionSpec,
    changes: Mapping[str, Any],
    faults: Mapping[str, ProtectedElement],
    sources: Mapping[str, CampaignSpec],
    flights: int,
) -> CampaignSpec:
    """The campaign of a design that flies ``flights`` times each of ``faults``, in each world.

    ``sources`` are the campaigns by label that the elements and protections were flown in: no seed of theirs
    is flown again, neither of a mission nor of a fault. Each flight has a seed of its own.
    """
    beyond = max(one.mission.seed + one.runs for one in sources.values())
    most = max(one.runs for one in sources.values())
    worlds = sources[next(iter(faults.values())).bare.campaign].worlds
    fields = mission.model_dump(mode="json", exclude_defaults=True) | {"seed": beyond}
    return CampaignSpec(
        name=name,
        runs=flights,
        mission=MissionSpec.model_validate(fields),
        arms=(Arm(name=name, mission=dict(changes)),),
        worlds=worlds,
        faults=tuple(
            Condition(
                name=fault,
                fault=one.fault.model_copy(update={"seed": one.fault.seed + most}),
            )
            for fault, one in faults.items()
        ),
    )


def to_toml(campaign: CampaignSpec, about: Sequence[str]) -> str:
    """A campaign as the text of a TOML file, below lines of comment that say what it is ``about``."""
    fields = campaign.model_dump(mode="json", exclude_defaults=True)
    lines = [f"# {line}".rstrip() for line in about]
    lines += [f"{name} = {_value(fields.pop(name))}" for name in ("name", "runs")]
    if fields.get("worlds"):
        lines.append(f"worlds = {_value(fields['worlds'])}")
    lines += ["", "[mission]", *(f"{_key(name)} = {_value(one)}" for name, one in fields["mission"].items())]
    for table in ("arms", "faults"):
        for entry in fields[table]:
            told = (f"{_key(name)} = {_value(one)}" for name, one in entry.items() if one is not None)
            lines += ["", f"[[{table}]]", *told]
    return "\n".join(lines) + "\n"


def _value(value: Any) -> str:
    """A value in TOML on one line; what is None in a table is left out."""
    if isinstance(value, Mapping):
        told = ", ".join(f"{_key(name)} = {_value(one)}" for name, one in value.items() if one is not None)
        return f"{{ {told} }}" if told else "{}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return json.dumps(value)


def _key(name: str) -> str:
    return name if name.isascii() and name.replace("_", "").replace("-", "").isalnum() else _value(name)
