"""The table of kernels: the only place where a kernel is declared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True, slots=True)
class Kernel:
    """One kernel: its stage, where it is entered, and the libraries whose code it runs.

    ``modules`` are file name prefixes of shared libraries; kernels compiled by numba run in anonymous
    memory and name none.
    """

    name: str
    stage: str
    entry: str
    modules: tuple[str, ...] = ()


_TABLE = (
    Kernel("point_cloud", "perception", "services.perception.point_cloud:point_cloud"),
    Kernel("octomap", "perception", "services.perception.occupancy:OccupancyMap.insert", ("liboctomap",)),
    Kernel(
        "collision_check", "perception", "services.perception.collision:time_to_collision", ("liboctomap",)
    ),
    Kernel("rrt", "planning", "services.planning.planners:plan", ("libompl",)),
    Kernel("rrt_connect", "planning", "services.planning.planners:plan", ("libompl",)),
    Kernel("rrt_star", "planning", "services.planning.planners:plan", ("libompl",)),
    Kernel("prm_star", "planning", "services.planning.planners:plan", ("libompl",)),
    Kernel("lawn_mower", "planning", "services.planning.sweep:lawn_mower"),
    Kernel("frontier", "planning", "services.planning.frontier:frontier"),
    Kernel("trajectory", "planning", "services.planning.trajectory:trajectory"),
    Kernel("pid", "control", "services.control.pid:pid"),
)

KERNELS: Mapping[str, Kernel] = MappingProxyType({kernel.name: kernel for kernel in _TABLE})

PLANNERS: tuple[str, ...] = tuple(
    name for name, kernel in KERNELS.items() if kernel.entry.endswith("planners:plan")
)
"""The kernels that a mission chooses one of."""

GOAL_KERNELS: Mapping[str, str] = MappingProxyType(
    {"scanning": "lawn_mower", "mapping": "frontier", "search": "frontier"}
)
"""The kernel that chooses the goals of a mission; the other missions have theirs given."""
