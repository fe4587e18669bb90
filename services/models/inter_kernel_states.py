"""The table of inter-kernel states: the numbers that pass from stage to stage and that a fault may strike.

What the paper injects into at source level and what its detectors watch (facts page, "Monitored
inter-kernel states"). A state is one number of a message, or one in each point of a trajectory or cloud.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.bus.arrays import POINT_FIELDS
from services.bus.topics import TOPICS

Values = NDArray[Any]
"""float64, float32 or uint32, as the state is."""


@dataclass(frozen=True, slots=True)
class InterKernelState:
    """One state: the topic that carries it, where it stands in the message, and its type.

    ``path`` are the fields from the message down to it. With a ``stride`` the last field is an array and
    the state is every ``stride``-th number of it from ``column`` on.
    """

    name: str
    topic: str
    path: tuple[str, ...]
    dtype: type[np.float64] | type[np.float32] | type[np.uint32] = np.float64
    column: int = 0
    stride: int = 0

    @property
    def width_bits(self) -> int:
        """The width of one value in bits."""
        return 8 * np.dtype(self.dtype).itemsize

    @property
    def floating(self) -> bool:
        """Whether the values are floating-point numbers, with sign, exponent and mantissa."""
        return issubclass(self.dtype, np.floating)

    @property
    def stage(self) -> str:
        """The stage that publishes the state."""
        return TOPICS[self.topic].publisher

    def values(self, message: Any) -> Values:
        """A copy of the state's values (n,) in ``message``: one, or one for each point."""
        held = reduce(getattr, self.path, message)
        if not self.stride:
            return np.array([held], dtype=self.dtype)
        values: Values = held.view(self.dtype)[self.column :: self.stride].copy()
        return values

    def put(self, message: Any, values: Values) -> None:
        """Replace the state's values in ``message``; arrays that others may hold stay as they are."""
        *way, last = self.path
        holder = reduce(getattr, way, message)
        if not self.stride:
            setattr(holder, last, values[0].item())
            return
        array = getattr(holder, last).copy()
        array.view(self.dtype)[self.column :: self.stride] = values
        setattr(holder, last, array)


def _point(column: int, name: str) -> InterKernelState:
    return InterKernelState(f"trajectory.{name}", "trajectory", ("points",), np.float64, column, POINT_FIELDS)


_POINT_COLUMNS = ("t", "x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az", "yaw")
_TABLE = (
    *(
        InterKernelState(f"cloud.{axis}", "cloud", ("data",), np.float32, column, 3)
        for column, axis in enumerate("xyz")
    ),
    InterKernelState("collision_check.time_to_collision", "collision_check", ("time_to_collision",)),
    InterKernelState(
        "collision_check.future_collision_seq", "collision_check", ("future_collision_seq",), np.uint32
    ),
    *(_point(column, name) for column, name in enumerate(_POINT_COLUMNS)),
    InterKernelState("trajectory.trajectory_seq", "trajectory", ("trajectory_seq",), np.uint32),
    InterKernelState("trajectory.future_collision_seq", "trajectory", ("future_collision_seq",), np.uint32),
    *(InterKernelState(f"command.v{axis}", "command", ("twist", "linear", axis)) for axis in "xyz"),
    InterKernelState("command.yaw_rate", "command", ("twist", "angular", "z")),
)

STATES: Mapping[str, InterKernelState] = MappingProxyType({state.name: state for state in _TABLE})

GROUPS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "cloud.position": ("cloud.x", "cloud.y", "cloud.z"),
        "trajectory.position": ("trajectory.x", "trajectory.y", "trajectory.z"),
        "trajectory.velocity": ("trajectory.vx", "trajectory.vy", "trajectory.vz"),
        "trajectory.acceleration": ("trajectory.ax", "trajectory.ay", "trajectory.az"),
        "command.velocity": ("command.vx", "command.vy", "command.vz"),
    }
)
"""Vectors, of which a fault strikes one component or all."""


def members(target: str) -> tuple[InterKernelState, ...]:
    """The states that a name stands for: a state, or the components of a group.

    :raises KeyError: if it is neither.
    """
    return tuple(STATES[name] for name in GROUPS.get(target, (target,)))
