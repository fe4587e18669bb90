"""Perception's kernels on frames that were recorded in flight: the last ones before a collision was found."""

from __future__ import annotations

from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.bus.arrays import cloud_message, plan, state, verdict
from services.bus.messages import Header
from services.perception.collision import time_to_collision
from services.perception.messages import depth_array, pinhole
from services.perception.occupancy import OccupancyMap
from services.perception.point_cloud import in_world, point_cloud
from services.runtime.kernel_trial import KernelTrial, NoSampleError, Sample, SampleFlight, cdr, decoded

FRAMES = 5
"""In a sample: as many as a small file holds, enough for a map with walls in it."""


def record(flight: SampleFlight) -> Sample:
    """The newest frames at the first verdict that found a collision, and the trajectory it was on.

    :raises NoSampleError: if no collision was found, or none is in a map of these frames alone.
    """
    messages = flight.messages
    verdicts = [verdict(decoded("collision_check", cdr(one))) for one in messages["collision_check"]]
    found = next((i for i, one in enumerate(verdicts) if isfinite(one.time_to_collision_s)), 0)
    maps = messages["map"]
    # The frame of each cloud, by its stamp; the map of the verdict is made of those up to its own.
    stamps = [_stamp_ns(decoded("cloud", cdr(one)).header) for one in messages["cloud"]]
    used = stamps[max(found - FRAMES + 1, 0) : found + 1]
    if len(used) < FRAMES or len(maps) <= found:
        raise NoSampleError("no collision was found on the way")
    frames = {one.ready_ns: one for one in messages["depth"]}
    poses = {one.ready_ns: one for one in messages["odometry"]}
    checked = verdicts[found]
    flown = next(
        one
        for one in messages["trajectory"]
        if plan(decoded("trajectory", cdr(one))).trajectory_seq == checked.trajectory_seq
    )
    mapping = flight.spec.mapping
    sample: dict[str, NDArray[Any]] = {
        "camera_info": cdr(messages["camera_info"][0]),
        "trajectory": cdr(flown),
        "checked_s": np.array(checked.checked_s),
        "map": np.array([mapping.resolution_m, mapping.range_m]),
    }
    for index, stamp_ns in enumerate(used):
        sample[f"depth_{index}"] = cdr(frames[stamp_ns])
        sample[f"odometry_{index}"] = cdr(poses[stamp_ns])
    _verify(sample, flight, found)
    return sample


def _stamp_ns(header: Header) -> int:
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def _verify(sample: Sample, flight: SampleFlight, found: int) -> None:
    """Check that the kernels reproduce the flight's own cloud and find the collision again.

    :raises NoSampleError: if not.
    """
    cloud, check = PointCloudTrial("", sample), CollisionCheckTrial("", sample)
    cloud.run()
    check.run()
    flown = decoded("cloud", cdr(flight.messages["cloud"][found]))
    if not np.array_equal(cloud_message(flown.header, cloud.points).data, flown.data):
        raise NoSampleError("the frame of the flight does not give its cloud")
    if not isfinite(check.left_s):
        raise NoSampleError("the collision is not in a map of the newest frames alone")


class PointCloudTrial(KernelTrial):
    """The newest frame's cloud: points (n, 3), then the ends of rays that met nothing, optical frame, m."""

    def __init__(self, _: str, sample: Sample, frame: int = FRAMES - 1) -> None:
        image = depth_array(decoded("depth", sample[f"depth_{frame}"]))
        pose = state(decoded("odometry", sample[f"odometry_{frame}"]))
        lens = pinhole(decoded("camera_info", sample["camera_info"]))
        self.position, self.attitude = pose.position, pose.attitude
        self._arguments: tuple[Any, ...] = image, *lens, float(sample["map"][1])
        self.points = self.misses = np.empty((0, 3), dtype=np.float32)

    def run(self) -> None:
        """Compute the point cloud of the sample."""
        self.points, self.misses = point_cloud(*self._arguments)

    def values(self) -> NDArray[Any]:
        """The points of the cloud that was computed, then the ends of rays that met nothing."""
        return np.concatenate([self.points, self.misses])

    def image(self) -> bytes:
        """Every bit, and which points are ends of rays that met nothing."""
        return f"{len(self.points)} ".encode() + super().image()

    def insert(self, occupancy: OccupancyMap) -> None:
        """Insert what was computed into a map."""
        occupancy.insert(in_world(self.points, self.misses, self.position, self.attitude), self.position)


class OctomapTrial(KernelTrial):
    """The newest cloud inserted into the map of the frames before it.

    Every bit is OctoMap's stream with all log-odds; what matters is the label of each voxel in reach
    (-1 unknown, 0 free, 1 occupied), which is what others see of the map.
    """

    def __init__(self, _: str, sample: Sample) -> None:
        self.occupancy = _map(sample, FRAMES - 1)
        self.newest = PointCloudTrial("", sample)
        self.newest.run()

    def run(self) -> None:
        """Insert the newest cloud into the map."""
        self.newest.insert(self.occupancy)

    def values(self) -> NDArray[Any]:
        """The labels of the map's voxels after the insertion."""
        step = self.occupancy.resolution_m
        reach = np.arange(-self.occupancy.range_m, self.occupancy.range_m + step, step)
        around = np.stack(np.meshgrid(reach, reach, reach, indexing="ij"), axis=-1).reshape(-1, 3)
        centres = (np.floor((self.newest.position + around) / step) + 0.5) * step
        return self.occupancy.labels(centres)

    def image(self) -> bytes:
        """The map's stream with all log-odds."""
        return self.occupancy.to_stream()


class CollisionCheckTrial(KernelTrial):
    """The trajectory checked against the map of all frames: time to collision, s."""

    def __init__(self, _: str, sample: Sample) -> None:
        self._points = plan(decoded("trajectory", sample["trajectory"])).points
        self._checked_s = float(sample["checked_s"])
        self._occupancy = _map(sample, FRAMES)
        self.left_s = np.nan

    def run(self) -> None:
        """Check the sample's trajectory for a collision."""
        self.left_s = time_to_collision(self._points, self._checked_s, self._occupancy)

    def values(self) -> NDArray[Any]:
        """The time to collision that was found, in seconds."""
        return np.array([self.left_s])


def _map(sample: Sample, frames: int) -> OccupancyMap:
    """The map of the first frames of a sample."""
    resolution_m, range_m = sample["map"]
    occupancy = OccupancyMap(float(resolution_m), float(range_m))
    for frame in range(frames):
        cloud = PointCloudTrial("", sample, frame)
        cloud.run()
        cloud.insert(occupancy)
    return occupancy
