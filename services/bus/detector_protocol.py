"""Requests of stages to a detector and its replies, as bytes on the bus.

A question is whether the stage has a predecessor to be compared with, then the rows that the detector is
shown, float64 one after the other: an output's monitored values, the columns those of
``detector/series/monitored_states.py``. An answer is empty, or an alarm as JSON.
"""

from __future__ import annotations

import json
import struct
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from services.bus.arrays import POINT_FIELDS, Floats, VehicleState
from services.bus.messages import TwistStamped

_HEAD = struct.Struct("<q")
_FRESH = 1

Ask = Callable[[bytes], bytes | None]
"""Ask the detector; None if nobody answers."""


class DetectorReply(NamedTuple):
    """An alarm: the state, its row in the check, and the score, which is above 1."""

    state: str
    row: int
    score: float


def question(rows: Floats, *, fresh: bool) -> bytes:
    """Encode a request to judge ``rows``; ``fresh``: they follow nothing that was asked before."""
    return _HEAD.pack(_FRESH if fresh else 0) + np.ascontiguousarray(rows, dtype=np.float64).tobytes()


def asked(payload: bytes) -> tuple[Floats, bool]:
    """The numbers (n,) of a question, read-only, and whether it is fresh.

    :raises ValueError: if it is none.
    """
    if len(payload) < _HEAD.size:
        message = f"{len(payload)} bytes are no question"
        raise ValueError(message)
    return np.frombuffer(payload, dtype=np.float64, offset=_HEAD.size), bool(_HEAD.unpack_from(payload)[0])


def answer(found: DetectorReply | None) -> bytes:
    """Encode a detector's reply. An infinite score becomes the largest number: JSON has none."""
    if found is None:
        return b""
    return json.dumps(found._replace(score=min(found.score, sys.float_info.max))).encode()


def answered(payload: bytes) -> DetectorReply | None:
    """Decode a detector's reply: the alarm, or None if there is none."""
    return DetectorReply(*json.loads(payload)) if payload else None


def shown_verdict(message: Any) -> Floats:
    """(1, 2), of a CollisionCheck: time to collision and the count of collisions."""
    return np.array([[message.time_to_collision, message.future_collision_seq]], dtype=np.float64)


def shown_trajectory(message: Any) -> Floats:
    """(points, 13), of a Trajectory: t, position, velocity, acceleration, yaw; in each row both counts."""
    points = message.points.reshape(-1, POINT_FIELDS)[:, :11]
    counts = (float(message.trajectory_seq), float(message.future_collision_seq))
    return np.hstack((points, np.tile(counts, (len(points), 1))))


def shown_command(message: TwistStamped, curves: int, waypoints: Floats, measured: VehicleState) -> Floats:
    """(2, 21): the count of curves, ``waypoints`` (the row behind and the tracked one); twice the command and
    the position and velocity that were ``measured`` before it.
    """
    linear, turn = message.twist.linear, message.twist.angular.z
    flown = np.tile((linear.x, linear.y, linear.z, turn, *measured.position, *measured.velocity), (2, 1))
    return np.hstack((np.full((2, 1), float(curves)), waypoints, flown))
