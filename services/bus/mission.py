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

    ``trigger`` may be left out; it is drawn then, from ``seed``. A stored outcome's specification says
    exactly when the fault struck.
    """

    level: Literal["instruction"] = "instruction"
    target: str = Field(description="kernel, as named in services/kernels.py")
    seed: Seed = Field(default=0, ge=0, lt=2**32)
    operand: Literal["source", "destination", "any"] = "any"
    register_class: Literal["gpr", "vector", "any"] = "any"
    trigger: Trigger | None = None


class Site(Strict):
    """One dynamic instruction of a call, so that it can be found again.

    It is ``steps`` instructions after the ``hit``-th pass of the thread through ``offset`` of ``module``
    (no module: the address itself) since the call began; without a ``hit``, after the call's beginning.
    ``code`` and ``registers`` are what must be found there before a bit is flipped; empty: not known yet.
    """

    rung: Literal["exact", "occurrence"]
    step: int | None = Field(default=None, ge=0, description="number in the call, counted from 0; exact only")
    module: str = ""
    build_id: str = ""
    offset: int = Field(default=0, ge=0)
    hit: int = Field(default=0, ge=0)
    steps: int = Field(default=0, ge=0)
    code: str = Field(default="", description="bytes of the instruction")
    registers: str = Field(default="", description="hash of those that it reads, addresses left out")


class Trigger(Strict):
    """When a fault strikes: in which call of the kernel, and where in it.

    The call is the ``invocation``-th, or the first that begins at ``after_ns`` of virtual time or later.
    The place is a ``site``, or ``cpu_ns`` of thread time after the beginning. What is not given is drawn:
    the call uniformly ``over`` the golden twin's calls or its flight time, the place by the injector when
    the call comes. The specification in an outcome has all of it.
    """

    over: Literal["calls", "time"] = "calls"
    invocation: int | None = Field(default=None, ge=0)
    after_ns: int | None = Field(default=None, ge=0)
    site: Site | None = None
    cpu_ns: int | None = Field(default=None, ge=0)

    @property
    def names_a_call(self) -> bool:
        """Whether it need not be drawn which call is struck."""
        return self.invocation is not None or self.after_ns is not None


class Limits(Strict):
    """When a mission is given up, and how a failed node comes back."""

    mission_time_s: float = Field(default=200.0, gt=0, le=3600, description="virtual time")
    restarts: int = Field(default=3, ge=0, le=100, description="of one node")
    restart_delay_s: float = Field(default=0.5, ge=0, le=60, description="virtual time")
    hang_cpu_s: float = Field(default=3.0, gt=0, le=600, description="thread time within one step")


class MissionSpec(Strict):
    """Everything that a flight depends on: same specification, same bytes.

    ``world``, ``airframe`` and ``platform`` are a name or a definition of one's own. Where a
    specification is written, ``profile`` stands for the fields of a profile that it leaves out.
    """

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
