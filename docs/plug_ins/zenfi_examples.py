"""One plug-in of each kind: a planner, a guard, a world, a pilot, a fault mask and a signal."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from ompl import geometric
from pydantic import Field

from services.bus.arrays import POINT_FIELDS
from services.models.base import Strict
from services.models.faults.mask_histogram import MaskHistogram
from services.models.pilots import PILOTS
from services.models.plug_ins import MessageGuard, OmplPlanner, Signal, WorldGenerator

BIT_STAR = OmplPlanner(geometric.BITstar, latency_as="rrt_star")


FARTHEST_M = 200.0


def _too_far(topic: str, message: Any) -> str:
    """What is wrong with a trajectory that leads far out of the area."""
    if topic != "trajectory":
        return ""
    farthest = np.abs(message.points.reshape(-1, POINT_FIELDS)[:, 1:4]).max(initial=0.0)
    return f"a point {farthest:.0f} m away" if farthest > FARTHEST_M else ""


NEAR = MessageGuard(("control",), "refuses trajectories that lead farther than 200 m", "nothing", _too_far)


class SpiralParameters(Strict):
    """Of a spiral of towers."""

    towers: int = Field(default=24, ge=3, le=1000)
    side_m: float = Field(default=1.5, gt=0, le=10)


def _spiral(definition: Any, wanted: SpiralParameters, rng: np.random.Generator) -> NDArray[np.float64]:
    """Square towers on a spiral around the middle of the area, turned by a drawn angle."""
    low, high = np.array(definition.lower), np.array(definition.upper)
    part = np.arange(1, wanted.towers + 1) / wanted.towers
    angle = rng.uniform(0.0, 2.0 * np.pi) + 4.0 * np.pi * part
    reach = 0.45 * part * (high - low)[:2].min()
    centre = (low + high)[:2] / 2 + np.column_stack([np.cos(angle), np.sin(angle)]) * reach[:, None]
    ground = np.full((wanted.towers, 1), low[2])
    half = wanted.side_m / 2
    return np.hstack([centre - half, ground, centre + half, ground + 20.0])


SPIRAL = WorldGenerator("towers on a spiral", _spiral, SpiralParameters)

GENTLE = PILOTS["guarded"]._replace(about="ours with weaker gains", proportional_level=0.8, derivative=0.05)

DOUBLE = MaskHistogram(bits={1: 0.9, 2: 0.1})


def _climb(_spec: Any, path: Any, _twin: Any) -> NDArray[np.float64]:
    """The rate of climb, m/s, over each time of a path."""
    return np.gradient(path.position[:, 2], path.time_s)


CLIMB = Signal("m/s, rate of climb", _climb)
