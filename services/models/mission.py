"""The specification of a mission: the one definition of all that can be asked of a flight.

Names of worlds, planners, pilots, guards, airframes and platforms are checked against the tables that
declare them by :func:`deploy.config.check.check`; here only form and range are.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, field_validator, model_validator

from services.bus.message_checks import ALL_CHECKS, Checks
from services.bus.topics import PLANNER, Topic
from services.models.airframe import AirframeDefinition
from services.models.base import Strict
from services.models.detection import DetectorSpec
from services.models.equipment import PROFILES, Camera, Imu, Link, MapSettings, Motion, Odometry, Wind
from services.models.faults.specification import FaultSpec
from services.models.oracles.harm import HarmSpec
from services.models.oracles.properties import PropertyText
from services.models.own_stack import OwnStack, OwnStage
from services.models.pilots import Guards, Pace, find_pilot
from services.models.platform import PlatformDefinition
from services.models.world import WorldDefinition


def _form(value: object) -> str:
    return "name" if isinstance(value, str) else "definition"


def _label(named: str | Strict) -> str:
    return named if isinstance(named, str) else str(named.name)  # type: ignore[attr-defined]


World = Annotated[
    Annotated[str, Tag("name")] | Annotated[WorldDefinition, Tag("definition")], Discriminator(_form)
]
Airframe = Annotated[
    Annotated[str, Tag("name")] | Annotated[AirframeDefinition, Tag("definition")], Discriminator(_form)
]
Platform = Annotated[
    Annotated[str, Tag("name")] | Annotated[PlatformDefinition, Tag("definition")], Discriminator(_form)
]


class Limits(Strict):
    """When a mission is given up, and how a failed node comes back."""

    mission_time_s: float = Field(default=200.0, gt=0, le=3600, description="virtual time")
    restarts: int = Field(default=3, ge=0, le=100, description="of one node")
    restart_delay_s: float = Field(default=0.5, ge=0, le=60, description="virtual time")
    hang_cpu_s: float = Field(default=3.0, gt=0, le=600, description="thread time within one step")


class Area(Strict):
    """The level rectangle that a mission covers: corners (x, y) in the world frame.

    A corner that is left out follows from the world's start and goal (:func:`sim.mission.area.corners`).
    """

    lower: tuple[float, float] | None = None
    upper: tuple[float, float] | None = None
    swath_m: float = Field(default=8.0, ge=1, le=50, description="width that one pass of a sweep covers")
    coverage: float = Field(default=0.9, gt=0, le=1, description="covered part of the area that is enough")


class MissionSpec(Strict):
    """Everything that a flight depends on: same specification, same bytes.

    ``world``, ``airframe`` and ``platform`` are a name or a definition of one's own. Where a
    specification is written, ``profile`` stands for the fields of a profile that it leaves out.
    """

    mission: Literal["navigation", "scanning", "mapping", "search", "delivery"] = "navigation"
    area: Area = Area()
    world: World = "sparse"
    seed: int = Field(default=0, ge=0, lt=2**32)
    airframe: Airframe = "airsim"
    planner: str = "rrt_star"
    clock: Literal["lockstep", "realtime"] = "lockstep"
    platform: Platform = "i9-9940x"
    energy: Literal["airframe", "regression", "momentum"] = "airframe"
    camera: Camera = Camera()
    imu: Imu = Imu()
    odometry: Odometry = Odometry()
    mapping: MapSettings = MapSettings()
    motion: Motion = Motion()
    pilot: str = Field(default="guarded", description="guarded (ours), baseline (published) or a plug-in")
    guards: tuple[str, ...] | None = Field(default=None, description="these only; default: the pilot's")
    pace: Pace = Pace()
    wind: Wind = Wind()
    link: Link = Link()
    detector: DetectorSpec | None = None
    stack: OwnStack | None = None
    fault: FaultSpec | None = None
    limits: Limits = Limits()
    properties: tuple[PropertyText, ...] = Field(default=(), max_length=50)
    harm: HarmSpec = HarmSpec()

    @property
    def active_guards(self) -> Guards:
        """The guards that are switched on."""
        return find_pilot(self.pilot).guards if self.guards is None else frozenset(self.guards)

    @property
    def message_checks(self) -> Checks:
        """Those of them that are checks of messages."""
        return frozenset(name for name in ALL_CHECKS if name in self.active_guards)

    def own_stage(self, stage: str) -> OwnStage | None:
        """The own stage that replaces a stage of ours, if there is one."""
        return None if self.stack is None else self.stack.of(stage)

    def kernels_before(self, topic: Topic) -> tuple[str, ...]:
        """The kernels that at least run between a topic's trigger and its message."""
        if self.own_stage(topic.publisher) is not None:
            return (topic.publisher,)
        return tuple(self.planner if name == PLANNER else name for name in topic.after)

    @property
    def world_name(self) -> str:
        """The name of the mission's world."""
        return _label(self.world)

    @field_validator("properties")
    @classmethod
    def _each_once(cls, properties: tuple[str, ...]) -> tuple[str, ...]:
        twice = next((one for one in properties if properties.count(one) > 1), None)
        if twice is not None:
            message = f"twice the same property: {twice}"
            raise ValueError(message)
        return properties

    @model_validator(mode="before")
    @classmethod
    def _expand_profile(cls, given: Any) -> Any:
        if not isinstance(given, dict) or "profile" not in given:
            return given
        fields = dict(given)
        name = fields.pop("profile")
        if not isinstance(name, str) or name not in PROFILES:
            message = f"unknown profile {name!r}; known: {', '.join(PROFILES)}"
            raise ValueError(message)
        return {**PROFILES[name], **fields}
