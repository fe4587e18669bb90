"""Maps for the tests of planning, made by OctoMap itself."""

import numpy as np
import pyoctomap
from numpy.typing import NDArray

from services.planning.voxels import VoxelGrid, unpack

RESOLUTION_M = 0.5
LOW, HIGH = np.array([-10.0, -20.0, 1.0]), np.array([40.0, 20.0, 10.0])
START, GOAL = np.array([0.0, 0.0, 3.0]), np.array([30.0, 0.0, 3.0])

Points = NDArray[np.float64]


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Points:
    """Centres of all voxels in a box."""
    axes = [np.arange(a + RESOLUTION_M / 2, b, RESOLUTION_M) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def tree(occupied: Points, free: Points | None = None) -> pyoctomap.OcTree:
    """An octree in which these voxels are known."""
    octree = pyoctomap.OcTree(RESOLUTION_M)
    for points, value in ((free, False), (occupied, True)):
        for point in points if points is not None else ():
            octree.updateNode(point, value)
    return octree


def payload(octree: pyoctomap.OcTree) -> bytes:
    """The tree as OctoMap's own binary stream, without its header."""
    stream: bytes = octree.writeBinary()
    return stream[stream.index(b"\ndata\n") + 6 :]


def grid(occupied: Points, free: Points | None = None) -> VoxelGrid:
    """The grid of a map in which these voxels are known."""
    return unpack(payload(tree(occupied, free)), RESOLUTION_M, LOW, HIGH)


def open_space() -> VoxelGrid:
    return unpack(b"", RESOLUTION_M, LOW, HIGH)


def wall_with_ends() -> VoxelGrid:
    """A wall across the way that can be passed on either side, seen from all around."""
    wall = box((14.0, -6.0, 0.0), (15.0, 6.0, 11.0))
    return grid(wall, box((8.0, -12.0, 0.0), (21.0, 12.0, 11.0)))
