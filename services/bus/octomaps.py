"""Octomap messages unpacked: what a binary octree knows of each voxel in a box."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.bus.message_checks import ALL_CHECKS, Checks, refuse
from services.bus.messages import MalformedMessageError

# What is known of a voxel.
UNKNOWN, SEEN_FREE, SEEN_OCCUPIED = 0, 1, 2

_DEPTH = 16  # levels of an octree in OctoMap
_CENTRE = 1 << (_DEPTH - 1)  # key of the voxel whose lower corner is the world's origin


RESOLUTIONS_M = (0.01, 10.0)
MOST_VOXELS = 2**30
"""Of a grid, rim included. A map finer than these, or a way longer, is none that can be planned in."""


class MalformedMap(MalformedMessageError):  # noqa: N818 - the map is, not the program
    """A message that holds no map to plan in."""


def sound_map(message: Any, checks: Checks = ALL_CHECKS) -> Any:
    """The ``octomap_msgs/Octomap`` message itself.

    :raises MalformedMap: if it is not a binary octree, or has a resolution that is no length.
    :raises RefusedMessageError: if it has an absurd resolution.
    """
    finest, coarsest = RESOLUTIONS_M
    if not (message.binary and message.id == "OcTree" and message.resolution > 0.0):
        raise MalformedMap(f"map: {message.id!r}, binary {message.binary}, resolution {message.resolution}")
    refuse(checks, "range", "map: absurd resolution", unless=finest <= message.resolution <= coarsest)
    return message


def known(
    payload: bytes, resolution_m: float, low: NDArray[np.float64], high: NDArray[np.float64], margin: int = 0
) -> NDArray[np.uint8]:
    """What the map knows of each voxel from ``low`` to ``high`` (3,) and ``margin`` more on each side.

    (nx, ny, nz), each ``UNKNOWN``, ``SEEN_FREE`` or ``SEEN_OCCUPIED``.

    :raises MalformedMap: if the data breaks off, goes on after the tree or branches too deep, or if the box
        is absurdly large.
    """
    # A comparison with NaN is false.
    if not np.prod((high - low) / resolution_m + 2 * margin) <= MOST_VOXELS:
        raise MalformedMap(f"no grid can be made from {low} to {high}")
    first = np.floor(low / resolution_m).astype(np.int64) - margin
    shape = np.ceil(high / resolution_m).astype(np.int64) + margin - first
    seen = np.zeros(shape, dtype=np.uint8)
    data = np.frombuffer(payload, dtype=np.uint8)
    if len(data) and (problem := _mark(data, first + _CENTRE, seen)):
        message = f"binary OctoMap of {len(data)} bytes: {problem}"
        raise MalformedMap(message)
    return seen


@njit(cache=True)
def _mark(data: NDArray[np.uint8], first: NDArray[np.int64], seen: NDArray[np.uint8]) -> str:
    """Set the known voxels of a binary stream in a grid that begins at key ``first``.

    The stream has, depth first, 16 bits for each node with children, two for a child: 0 unknown,
    1 free, 2 occupied, 3 with children. Child i lies towards +x, +y, +z by its bits 0, 1, 2.
    Returns what is wrong with the stream, or nothing.
    """
    bits = np.zeros(_DEPTH, dtype=np.int64)  # of the node open at each depth
    next_child = np.zeros(_DEPTH, dtype=np.int64)
    corner = np.zeros((_DEPTH + 1, 3), dtype=np.int64)
    if len(data) < 2:
        return "it breaks off"
    bits[0] = data[0] | np.int64(data[1]) << 8
    position, depth = 2, 0
    while depth >= 0:
        child = next_child[depth]
        if child == 8:
            depth -= 1
            continue
        next_child[depth] += 1
        label = bits[depth] >> 2 * child & 3
        if label == UNKNOWN:
            continue
        size = 1 << (_DEPTH - 1 - depth)
        for axis in range(3):
            corner[depth + 1, axis] = corner[depth, axis] + size * (child >> axis & 1)
        if label != 3:
            _fill(corner[depth + 1] - first, size, label, seen)
            continue
        if depth + 1 == _DEPTH:
            return "it branches below the smallest voxel"
        if position + 2 > len(data):
            return "it breaks off"
        depth += 1
        bits[depth] = data[position] | np.int64(data[position + 1]) << 8
        next_child[depth] = 0
        position += 2
    return "" if position == len(data) else "it goes on after the tree"


@njit(cache=True)
def _fill(corner: NDArray[np.int64], size: int, label: int, seen: NDArray[np.uint8]) -> None:
    nx, ny, nz = seen.shape
    for i in range(max(corner[0], 0), min(corner[0] + size, nx)):
        for j in range(max(corner[1], 0), min(corner[1] + size, ny)):
            for k in range(max(corner[2], 0), min(corner[2] + size, nz)):
                seen[i, j, k] = label
