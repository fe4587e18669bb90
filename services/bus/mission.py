"""What is asked of a mission: the one definition of its specification.

Names of worlds, planners, airframes and platforms are checked against the tables that
declare them by :func:`deploy.mission.check`; here only form and range are.
"""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

Seed = int


class Strict(BaseModel):
    """A frozen model that refuses unknown fields: a typing error must not pass as a default."""

    model_config = ConfigDict(extra="forbid", frozen=True)


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


class MissionSpec(Strict):
    """Everything that a flight depends on: same specification, same bytes."""

    world: str = "sparse"
    seed: Seed = Field(default=0, ge=0, lt=2**32)
    airframe: str = "airsim"
    planner: str = "rrt_star"
    platform: str = "i9-9940x"
    fault: FaultSpec | None = None
    limits: Limits = Limits()
