"""What is asked of a mission: the one definition of its specification.

Names of worlds, planners, airframes and platforms are checked against the tables that
declare them by :func:`deploy.check.check`; here only form and range are.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, model_validator

from services.bus.airframe import AirframeDefinition
from services.bus.equipment import Camera, Imu, Mapping, Motion, Odometry, Wind
from services.bus.model import Strict
from services.bus.platform import PlatformDefinition
from services.bus.profiles import PROFILES
from services.bus.world import WorldDefinition

Seed = int


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


class FaultSpec(Strict):
    """One fault: where, when and what is flipped.

    ``trigger`` is left out by people; :func:`deploy.pairing.draw_trigger` draws it from ``seed`` over
    the golden twin, so that a stored specification says exactly when the fault struck.
    """

    level: Literal["instruction"] = "instruction"
    target: str = Field(description="kernel, as named in services/kernels.py")
    seed: Seed = Field(default=0, ge=0, lt=2**32)
    operand: Literal["source", "destination", "any"] = "any"
    register_class: Literal["gpr", "vector", "any"] = "any"
    trigger: Trigger | None = None


class Trigger(Strict):
    """The moment of a fault: ``cpu_ns`` of thread time into the ``invocation``-th call of the kernel."""

    invocation: int = Field(ge=0)
    cpu_ns: int = Field(ge=0)


class Limits(Strict):
    """When a mission is given up, and how a failed node comes back."""

    mission_time_s: float = Field(default=200.0, gt=0, le=3600, description="virtual time")
    restarts: int = Field(default=3, ge=0, le=100, description="of one node")
    restart_delay_s: float = Field(default=0.5, ge=0, le=60, description="virtual time")
    hang_cpu_s: float = Field(default=3.0, gt=0, le=600, description="thread time within one step")


class Area(Strict):
    """The level rectangle that a mission covers: corners (x, y) in the world frame.

    A corner that is left out follows from the world's start and goal (:func:`sim.area.corners`).
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
    seed: Seed = Field(default=0, ge=0, lt=2**32)
    airframe: Airframe = "airsim"
    planner: str = "rrt_star"
    platform: Platform = "i9-9940x"
    energy: Literal["airframe", "regression", "momentum"] = "airframe"
    camera: Camera = Camera()
    imu: Imu = Imu()
    odometry: Odometry = Odometry()
    mapping: Mapping = Mapping()
    motion: Motion = Motion()
    wind: Wind = Wind()
    fault: FaultSpec | None = None
    limits: Limits = Limits()

    @property
    def world_name(self) -> str:
        """What the world is called."""
        return _label(self.world)

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
