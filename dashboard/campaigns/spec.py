"""What is asked of a campaign: arms x worlds x faults, flown on the same seeds."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path, PurePosixPath
from typing import Any, Literal, NamedTuple

from pydantic import Field, ValidationError, field_validator, model_validator

from dashboard.campaigns.executors.spec import ExecutorSpec, LocalSpec
from deploy.config.check import check
from deploy.config.definitions import inlined
from deploy.errors import BadSpecError, one_line
from services.models.base import Strict
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec, World
from services.models.own_stack import OwnStack

MAX_RUNS = 100_000
SEEDS = 2**32

LONGEST_NAME = 255
"""Bytes of a file's name (Linux, NAME_MAX)."""

LONGEST_FOLDER = 1000
"""Bytes of ``artefacts``; a whole path has at most 4096 (PATH_MAX), and more is in front of it and behind."""


class Condition(Strict):
    """One fault by name; None is no fault. Each run draws its own fault seed."""

    name: str = Field(min_length=1, max_length=60)
    fault: FaultSpec | None = None


class Arm(Condition):
    """One way of flying: the fields of the mission that it changes, and a fault of its own."""

    mission: dict[str, Any] = {}

    @field_validator("mission")
    @classmethod
    def _sound(cls, changes: dict[str, Any]) -> dict[str, Any]:
        """Checked on their own, so that a mistake is told with its place."""
        for field in ("seed", "fault", "world"):
            if field in changes:
                message = f"{field} is not an arm's to change: see the campaign's mission, worlds and faults"
                raise ValueError(message)
        return MissionSpec.model_validate(changes).model_dump(exclude_unset=True)


class StoppingSpec(Strict):
    """Stop at the first of ``looks`` (runs per cell) at which every cell's rate is known well enough.

    Known to +- ``margin``, or to +- ``relative`` times itself, which a rate of 0 never is. The rate is that
    of missions that fail or, ``of`` harm, of flights that a fault harmed beside their golden twin; golden
    cells then do not count. The intervals' level is 1 - 0.05 / (number of looks), so that all looks together
    err in 5 %.
    """

    margin: float | None = Field(default=None, gt=0, lt=0.5)
    relative: float | None = Field(default=None, gt=0, le=1)
    of: Literal["failure", "harm"] = "failure"
    looks: tuple[int, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _one_precision(self) -> StoppingSpec:
        if (self.margin is None) == (self.relative is None):
            raise ValueError("give either margin or relative")
        return self


class CampaignLimits(Strict):
    """When a worker is given up, and when the store is full."""

    attempts: int = Field(default=5, ge=1, le=100, description="at a run whose workers get lost")
    lease_s: float = Field(default=60.0, gt=0, le=86_400, description="wall time without a sign of life")
    disk_mb: int = Field(default=10_000, ge=1, description="size of the store at which campaigns pause")


class RecordingPolicy(Strict):
    """Whose files are kept: of no run, of those that failed, of all, or of a ``sample`` part of them."""

    keep: Literal["none", "failures", "all", "sample"] = "none"
    sample: float = Field(default=0.1, gt=0, le=1)
    disk_mb: int = Field(default=1000, ge=1, description="for a campaign's files; what is beyond is dropped")


class Cell(NamedTuple):
    """What the flights of one denominator have in common: the names of arm, world and fault."""

    arm: str
    world: str
    fault: str

    def __str__(self) -> str:
        return " / ".join(name for name in self if name)


class CampaignSpec(Strict):
    """``runs`` flights per cell; run i flies seed ``mission.seed + i % seeds``, in every cell alike.

    Cells are arms x worlds x faults. ``worlds`` left out is the mission's world. With ``faults``, each arm
    flies each of them, and arms have none of their own. Flights without a fault repeat bit for bit,
    so a cell without one flies each seed once.
    """

    name: str = Field(min_length=1, max_length=60, pattern=r"^[A-Za-z0-9._-]+$")
    runs: int = Field(ge=1, le=MAX_RUNS)
    seeds: int | None = Field(default=None, ge=1, description="different seeds; default: one per run")
    mission: MissionSpec = MissionSpec()
    arms: tuple[Arm, ...] = Field(min_length=1)
    worlds: tuple[World, ...] = ()
    faults: tuple[Condition, ...] = ()
    stop: StoppingSpec | None = None
    fly_all: bool = Field(default=False, description="fly every run in full, also one that can be proven")
    limits: CampaignLimits = CampaignLimits()
    executor: ExecutorSpec = LocalSpec()
    recording: RecordingPolicy = RecordingPolicy()
    artefacts: str = Field(default="", description="folder in the store's artefact folder, for its own")

    @field_validator("arms", "faults")
    @classmethod
    def _named_apart(cls, conditions: tuple[Condition, ...]) -> tuple[Condition, ...]:
        names = [condition.name for condition in conditions]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            message = f"two have the same name: {twice[0]}"
            raise ValueError(message)
        return conditions

    @field_validator("artefacts")
    @classmethod
    def _inside(cls, path: str) -> str:
        if PurePosixPath(path).is_absolute() or ".." in PurePosixPath(path).parts or "\0" in path:
            raise ValueError("must be a folder inside the store's artefact folder")
        return path

    @model_validator(mode="after")
    def _consistent(self) -> CampaignSpec:
        def refuse(message: str) -> None:
            raise ValueError(message)

        if self.mission.fault is not None:
            refuse("mission.fault: faults belong to arms or to the campaign's faults")
        if self.faults and any(arm.fault is not None for arm in self.arms):
            refuse("arms: a fault of an arm's own, beside the campaign's faults")
        if self.seeds is not None and self.seeds > self.runs:
            refuse(f"seeds: {self.seeds} seeds for {self.runs} runs")
        if self.mission.seed + self.runs > SEEDS:
            refuse(f"mission.seed: the last run's seed is beyond {SEEDS - 1}")
        looks = self.stop.looks if self.stop is not None else ()
        if any(late <= early for early, late in zip((0, *looks), (*looks, self.runs), strict=True)):
            refuse("stop.looks: must rise, and stay below runs")
        names = [mission.world_name for _, mission in _missions(self)][: max(len(self.worlds), 1)]
        if len(set(names)) < len(names):
            refuse("worlds: two have the same name")
        planned = self.runs * len(self.arms) * max(len(self.worlds), 1) * max(len(self.faults), 1)
        if planned > MAX_RUNS:
            refuse(f"runs: {planned} flights planned, at most {MAX_RUNS} are allowed")
        return self


@dataclass(frozen=True, slots=True)
class Run:
    """One flight of a campaign, as planned."""

    arm: str
    index: int
    spec: MissionSpec
    fault: str = ""

    @property
    def cell(self) -> Cell:
        """The cell (arm, world, fault) of the run."""
        return Cell(self.arm, self.spec.world_name, self.fault)

    @property
    def twin(self) -> MissionSpec:
        """The same flight without the fault."""
        return self.spec.model_copy(update={"fault": None})


def _missions(campaign: CampaignSpec) -> Iterator[tuple[Arm, MissionSpec]]:
    """Each arm's mission in each world, without seed and fault."""
    base = campaign.mission.model_dump(exclude_unset=True)
    for arm in campaign.arms:
        fields = {**base, **arm.mission}
        for name, value in arm.mission.items():
            if isinstance(value, dict) and isinstance(base.get(name), dict) and "name" not in value:
                fields[name] = {**base[name], **value}
        for world in campaign.worlds or (campaign.mission.world,):
            given = world if isinstance(world, str) else world.model_dump()
            yield arm, MissionSpec.model_validate({**fields, "world": given})


def stacks(campaign: CampaignSpec) -> list[OwnStack]:
    """Every stack of one's own that is flown, once per arm."""
    one_world = campaign.model_copy(update={"worlds": ()})
    return [mission.stack for _, mission in _missions(one_world) if mission.stack is not None]


def unprotected_arms(campaign: CampaignSpec) -> dict[str, str]:
    """For each arm with a detector, the arm that flies the same without one; where there is none, none."""
    one_world = campaign.model_copy(update={"worlds": ()})
    watched, bare = {}, {}
    for arm, mission in _missions(one_world):
        same = mission.model_copy(update={"detector": None}).model_dump_json(), arm.fault
        if mission.detector is not None:
            watched[arm.name] = same
        else:
            bare[same] = arm.name
    return {arm: bare[same] for arm, same in watched.items() if same in bare}


def arm_conditions(campaign: CampaignSpec) -> Iterator[tuple[str, Condition, MissionSpec]]:
    """Each arm's name with each fault that it flies, and its mission, in the first of the worlds."""
    for arm, condition, mission in _flown(campaign.model_copy(update={"worlds": campaign.worlds[:1]})):
        named = condition.name if campaign.faults else ""
        yield arm.name, condition.model_copy(update={"name": named}), mission


def _flown(campaign: CampaignSpec) -> list[tuple[Arm, Condition, MissionSpec]]:
    """The cells of a campaign: arm, fault and mission of each."""
    return [
        (arm, condition, mission)
        for arm, mission in _missions(campaign)
        for condition in campaign.faults or (Condition(name="none", fault=arm.fault),)
    ]


def cells(campaign: CampaignSpec) -> list[Cell]:
    """The names of every cell, in the order of the specification."""
    return [cell for cell, _ in mission_cells(campaign)]


def mission_cells(campaign: CampaignSpec) -> Iterator[tuple[Cell, MissionSpec]]:
    """Each cell with the mission of its first run, the fault included."""
    for arm, condition, mission in _flown(campaign):
        name = condition.name if campaign.faults else ""
        yield (
            Cell(arm.name, mission.world_name, name),
            mission.model_copy(update={"fault": condition.fault}),
        )


def runs(campaign: CampaignSpec) -> Iterator[Run]:
    """Every flight of a campaign, the flights of one seed side by side so that they share golden twins."""
    seeds = campaign.seeds or campaign.runs
    flown = _flown(campaign)
    for index in range(campaign.runs):
        for arm, condition, mission in flown:
            fault = condition.fault
            if fault is not None:
                fault = fault.model_copy(update={"seed": fault.seed + index})
            elif index >= seeds and mission.clock == "lockstep":
                continue
            spec = mission.model_copy(update={"seed": mission.seed + index % seeds, "fault": fault})
            yield Run(arm.name, index, spec, condition.name if campaign.faults else "")


def counted(campaign: CampaignSpec) -> tuple[int, int]:
    """How many runs a campaign has, and how many golden twins that are no runs of their own.

    As :func:`runs` plans them, but of cells: what differs between runs of a cell are seeds.
    """
    seeds = campaign.seeds or campaign.runs
    planned = 0
    golden, struck = set[str](), set[str]()
    for _, condition, mission in _flown(campaign):
        (golden if condition.fault is None else struck).add(mission.model_dump_json())
        repeats = condition.fault is None and mission.clock == "lockstep"
        planned += seeds if repeats else campaign.runs
    return planned, len(struck - golden) * seeds


def load_campaign(name: str) -> CampaignSpec:
    """The campaign in a TOML or JSON file, or the preset of that name.

    :raises BadSpecError: if there is neither, or if it is malformed; nothing is started then.
    """
    preset = files("dashboard") / "presets" / f"{name}.toml"
    path = Path(name)
    if path.suffix not in (".toml", ".json") and "/" not in name and preset.is_file():
        text = preset.read_text()
    elif path.is_file():
        text = path.read_text()
    else:
        message = f"no campaign file {name!r} and no preset of that name"
        raise BadSpecError(message)
    try:
        return campaign_of(_parsed(text, path))
    except (tomllib.TOMLDecodeError, json.JSONDecodeError) as error:
        message = f"{name}: not valid {'JSON' if path.suffix == '.json' else 'TOML'}: {error}"
        raise BadSpecError(message) from error
    except BadSpecError as error:
        message = f"{name}: {error}"
        raise BadSpecError(message) from error


def campaign_of(fields: object) -> CampaignSpec:
    """The campaign with these fields, as a file has them; what they name by file is read.

    :raises BadSpecError: if it is malformed or cannot be flown.
    """
    try:
        campaign = CampaignSpec.model_validate(_with_files(fields))
    except ValidationError as error:
        raise BadSpecError(one_line(error)) from error
    check_campaign(campaign)
    return campaign


def check_campaign(campaign: CampaignSpec) -> None:
    """Refuse what cannot be flown.

    :raises BadSpecError: naming arm or fault, and what would be right.
    """
    _check_folder(campaign.artefacts)
    for arm, condition, mission in _flown(campaign):
        try:
            check(mission.model_copy(update={"fault": condition.fault}))
        except BadSpecError as error:
            where = f"faults: {condition.name}" if campaign.faults else f"arms: {arm.name}"
            message = f"{where}: {error}"
            raise BadSpecError(message) from error


def _check_folder(path: str) -> None:
    """Refuse a folder that cannot be made, or that is or may become another campaign's own.

    :raises BadSpecError: saying which.
    """
    names = PurePosixPath(path).parts
    if not path.isprintable():
        raise BadSpecError("artefacts: a folder's name has no control characters")
    if any(len(name.encode()) > LONGEST_NAME for name in names) or len(path.encode()) > LONGEST_FOLDER:
        message = f"artefacts: a name has at most {LONGEST_NAME} bytes, the whole at most {LONGEST_FOLDER}"
        raise BadSpecError(message)
    taken = next((name for name in names if re.fullmatch(r"[A-Za-z0-9._-]+-[0-9]+", name)), None)
    if taken is not None:
        message = f"artefacts: {taken!r}: folders called NAME-NUMBER are the campaigns' own; choose another"
        raise BadSpecError(message)


def _parsed(text: str, path: Path) -> Any:
    return json.loads(text) if path.suffix == ".json" else tomllib.loads(text)


def _with_files(fields: Any) -> Any:
    """What a mission, an arm, a fault or the worlds name by file, put in their place."""
    if not isinstance(fields, dict):
        return fields
    fields = dict(fields)
    if isinstance(fields.get("mission"), dict):
        fields["mission"] = inlined(fields["mission"])
    if isinstance(fields.get("arms"), list):
        fields["arms"] = [
            {**arm, "mission": inlined(arm["mission"])}
            if isinstance(arm, dict) and isinstance(arm.get("mission"), dict)
            else arm
            for arm in fields["arms"]
        ]
    for name in ("arms", "faults"):
        if isinstance(fields.get(name), list):
            fields[name] = [inlined(one) if isinstance(one, dict) else one for one in fields[name]]
    if isinstance(fields.get("worlds"), list):
        fields["worlds"] = [inlined({"world": world})["world"] for world in fields["worlds"]]
    return fields
