"""What :func:`zenfi.fly` takes by name, for type checkers and editors; :class:`MissionSpec` checks it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypedDict

from services.models.airframe import AirframeDefinition
from services.models.detection import DetectorSpec
from services.models.equipment import Camera, Imu, Link, MapSettings, Motion, Odometry, Wind
from services.models.mission import Area, Limits
from services.models.oracles.harm import HarmSpec
from services.models.own_stack import OwnStack
from services.models.pilots import Pace
from services.models.platform import PlatformDefinition
from services.models.world import WorldDefinition

Fields = Mapping[str, Any]


class MissionFields(TypedDict, total=False):
    """The fields of a mission but for its fault: each as its model, as its fields or, of some, as a name."""

    mission: Literal["navigation", "scanning", "mapping", "search", "delivery"]
    area: Area | Fields
    world: WorldDefinition | Fields | Path | str
    seed: int
    airframe: AirframeDefinition | Fields | Path | str
    planner: str
    clock: Literal["lockstep", "realtime"]
    platform: PlatformDefinition | Fields | Path | str
    profile: Literal["fast", "paper"]
    energy: Literal["airframe", "regression", "momentum"]
    camera: Camera | Fields
    imu: Imu | Fields
    odometry: Odometry | Fields
    mapping: MapSettings | Fields
    motion: Motion | Fields
    pilot: str
    guards: Sequence[str] | None
    pace: Pace | Fields
    wind: Wind | Fields
    link: Link | Fields
    detector: DetectorSpec | Fields | str | None
    stack: OwnStack | Fields | Path | str | None
    limits: Limits | Fields
    properties: Sequence[str]
    harm: HarmSpec | Fields
