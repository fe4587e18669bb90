"""Messages for viewers: the obstacles, the vehicle, the planned path and the map, as RViz draws them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from rosbags.typesys.stores.ros2_jazzy import builtin_interfaces__msg__Duration as Duration
from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__PoseStamped as PoseStamped
from rosbags.typesys.stores.ros2_jazzy import nav_msgs__msg__Path as Path
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__CompressedImage as CompressedImage
from rosbags.typesys.stores.ros2_jazzy import std_msgs__msg__ColorRGBA as Colour
from rosbags.typesys.stores.ros2_jazzy import visualization_msgs__msg__Marker as Marker
from rosbags.typesys.stores.ros2_jazzy import visualization_msgs__msg__MeshFile as MeshFile

from services.bus import frames
from services.bus.arrays import Floats, cloud_message, plan, point, quaternion, turned, vector, xyz
from services.bus.messages import TYPESTORE, Header, Pose, header
from services.models.mission import MissionSpec
from services.models.safety import BODY_RADIUS_M
from sim.world import World, make_world

MOVING_PERIOD_NS = 200_000_000
"""Between two messages of where the moving obstacles are."""

MAP_PERIOD_NS = 1_000_000_000
"""Between two clouds of the occupied voxels: most of them are in the cloud before as well."""

_MarkerArray = TYPESTORE.types["visualization_msgs/msg/MarkerArray"]
_GREY, _ORANGE, _BROWN = (0.6, 0.6, 0.65, 1.0), (1.0, 0.55, 0.1, 1.0), (0.76, 0.42, 0.11, 1.0)


class Shape(NamedTuple):
    """A marker's size, m, and place in its frame."""

    kind: int
    centre: Floats
    size: Floats


class Visualization:
    """Makes the messages to draw of one flight: ``makers`` are by the topic from which they are made."""

    def __init__(self, spec: MissionSpec) -> None:
        self._spec = spec
        self._space: tuple[Floats, Floats] | None = None
        self._next_map_ns = 0
        self._moving: World | None = None
        self._next_moving_ns = 0
        self.makers: Mapping[str, Callable[[int, Any], Iterator[tuple[str, Any]]]] = {
            "goal": self._world,
            "odometry": self._around,
            "trajectory": _path,
            "map": self._occupied,
        }

    def _world(self, at_ns: int, goal: Any) -> Iterator[tuple[str, Any]]:
        self._space = xyz(goal.lower), xyz(goal.upper)
        at = header(at_ns, frames.MAP)
        world = make_world(self._spec.world, self._spec.seed)
        self._moving = world if len(world.moving) else None
        yield "obstacles", _markers(at, "obstacles", _cubes(world.fixed), _GREY)
        hull = Shape(Marker.SPHERE, np.zeros(3), np.full(3, 2 * BODY_RADIUS_M) * (1.0, 1.0, 0.2))
        yield "vehicle", _markers(header(at_ns, frames.BASE_LINK), "vehicle", [hull], _ORANGE)

    def _around(self, at_ns: int, _: Any) -> Iterator[tuple[str, Any]]:
        if self._moving is not None and at_ns >= self._next_moving_ns:
            self._next_moving_ns = at_ns + MOVING_PERIOD_NS
            cubes = _cubes(self._moving.moved(at_ns / 1e9))
            yield "moving_obstacles", _markers(header(at_ns, frames.MAP), "moving_obstacles", cubes, _BROWN)

    def _occupied(self, at_ns: int, octomap: Any) -> Iterator[tuple[str, Any]]:
        if self._space is None or at_ns < self._next_map_ns:
            return
        self._next_map_ns = at_ns + MAP_PERIOD_NS
        low, high = self._space
        resolution_m = octomap.resolution
        from services.bus.octomaps import SEEN_OCCUPIED, known  # noqa: PLC0415 - loads numba

        seen = known(octomap.data.tobytes(), resolution_m, low, high)
        found = np.flatnonzero(seen.ravel() == SEEN_OCCUPIED)  # in one dimension: ten times as fast
        cells = np.stack(np.unravel_index(found, seen.shape), axis=1) + np.floor(low / resolution_m) + 0.5
        yield "occupied", cloud_message(header(at_ns, frames.MAP), (cells * resolution_m).astype(np.float32))


def _cubes(boxes: Floats) -> list[Shape]:
    return [Shape(Marker.CUBE, (box[:3] + box[3:]) / 2, box[3:] - box[:3]) for box in boxes]


def _path(at_ns: int, trajectory: Any) -> Iterator[tuple[str, Any]]:
    """Each point with the time at which the vehicle is to be there."""
    poses = [
        PoseStamped(header=header(round(row[0] * 1e9), frames.MAP), pose=_level(row[1:4], row[10]))
        for row in plan(trajectory).points
        if 0.0 <= row[0] < 2**31
    ]
    yield "planned_path", Path(header=header(at_ns, frames.MAP), poses=poses)


def _level(position: Floats, yaw: float) -> Pose:
    return Pose(position=point(position), orientation=quaternion(turned(yaw)))


def _markers(at: Header, kind: str, shapes: list[Shape], colour: tuple[float, ...]) -> Any:
    made: list[Any] = [_marker(at, kind, number, shape, colour) for number, shape in enumerate(shapes)]
    return _MarkerArray(markers=made)


def _marker(at: Header, kind: str, number: int, shape: Shape, colour: tuple[float, ...]) -> Marker:
    red, green, blue, alpha = colour
    return Marker(
        header=at,
        ns=kind,
        id=number,
        type=shape.kind,
        action=Marker.ADD,
        pose=_level(shape.centre, 0.0),
        scale=vector(shape.size),
        color=Colour(r=red, g=green, b=blue, a=alpha),
        lifetime=Duration(sec=0, nanosec=0),
        frame_locked=True,
        points=[],
        colors=[],
        texture_resource="",
        texture=CompressedImage(header=at, format="", data=np.empty(0, dtype=np.uint8)),
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=MeshFile(filename="", data=np.empty(0, dtype=np.uint8)),
        mesh_use_embedded_materials=False,
    )
