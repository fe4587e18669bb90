"""Kinematic consistency: what one monitored value says must agree with what the others say.

Position, velocity and acceleration of two rows of a trajectory, h apart, are bound by the trapezoidal rule,
with its end correction for the position (Hermite; error h^5/720 x^(5)):

    x1 - x0 = h/2 (v0 + v1) - h^2/12 (a1 - a0),    v1 - v0 = h/2 (a0 + a1).

Planning's curve has six continuous derivatives, so in an error-free flight the first holds to millimetres:
any fault that moves a row by more is seen, in the mantissa too. Control's waypoints are such rows. A command
may differ from the waypoint's velocity by a bounded correction only, and changes smoothly. Time runs forward,
sequence numbers do not run back, and a collision that is new is counted. Each limit is the largest value of
the training flights times a margin.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Self

import numpy as np
from numba import njit

from detector.schemes.base import LIMIT, Alarm, Floats, Lesson, Scheme
from detector.series.monitored_states import WATCHED
from detector.series.series import Series
from services.models.base import Strict

MARGIN = 1.5
"""Of a limit over the largest value of the training flights."""

RELATIONS = (
    ("row_duration_s", "trajectory.t"),
    ("rows_per_s", "trajectory.t"),
    ("position_off_m", "trajectory.x"),
    ("velocity_off_m_s", "trajectory.vx"),
    ("speed_m_s", "trajectory.vx"),
    ("acceleration_m_s2", "trajectory.ax"),
    ("yaw_rad", "trajectory.yaw"),
    ("yaw_rate_rad_s", "trajectory.yaw"),
    ("trajectory_seq_step", "trajectory.trajectory_seq"),
    ("answered_step", "trajectory.future_collision_seq"),
    ("waypoint_duration_s", "trajectory.duration"),
    ("command_m_s", "command.vx"),
    ("command_off_waypoint_m_s", "command.vx"),
    ("command_step_m_s", "command.vx"),
    ("command_bend_m_s", "command.vx"),
    ("turn_rad_s", "command.yaw_rate"),
    ("turn_step_rad_s", "command.yaw_rate"),
    ("time_to_collision_s", "collision_check.time_to_collision"),
    ("collisions_step", "collision_check.future_collision_seq"),
)
"""What is measured, and the state that an alarm names (of a vector its first component)."""

(
    _ROW_DURATION,
    _ROWS_PER_S,
    _POSITION_OFF,
    _VELOCITY_OFF,
    _SPEED,
    _ACCELERATION,
    _YAW,
    _YAW_RATE,
    _TRAJECTORY_SEQ,
    _ANSWERED,
    _WAYPOINT_DURATION,
    _COMMAND,
    _COMMAND_OFF,
    _COMMAND_STEP,
    _COMMAND_BEND,
    _TURN,
    _TURN_STEP,
    _TTC,
    _COLLISIONS,
) = range(len(RELATIONS))

_EXACT = (_ANSWERED, _COLLISIONS)  # counted one by one: no margin
_KINDS = {"perception": 0, "planning": 1, "control": 2}
_WIDEST = 15
"""Columns of a check that the relations are between, the first ones."""

# How many checks before are remembered (two at most), and the last row of each.
_KNOWN, _LAST, _BEFORE = 0, 1, 1 + _WIDEST
_MEMORY = 1 + 2 * _WIDEST


class KinematicParameters(Strict):
    """The largest allowed value of every relation."""

    limits: dict[str, float]


class Kinematic(Scheme):
    """Watches all three stages; learns nothing in flight."""

    name: ClassVar[str] = "kinematic"

    def __init__(self, parameters: KinematicParameters) -> None:
        names = [name for name, _ in RELATIONS]
        limits = [parameters.limits.get(name, math.nan) for name in names]
        if len(parameters.limits) != len(names) or not all(limit >= 0.0 for limit in limits):
            message = "not one limit for each relation"
            raise ValueError(message)
        self._limits = np.array(limits)
        self._memory = {stage: np.zeros(_MEMORY) for stage in WATCHED}
        self._found = np.zeros(3)

    def check(self, stage: str, values: Floats) -> Alarm | None:
        """Judge one check by the relations between its values."""
        found = self._found
        inspect(_KINDS[stage], self._memory[stage], self._limits, values, found, True)
        if found[0] <= LIMIT:
            return None
        return Alarm(stage, RELATIONS[int(found[1])][1], int(found[2]), float(found[0]))

    def score(self, stage: str, values: Floats) -> float:
        """The relation that is farthest off, in units of its limit."""
        inspect(_KINDS[stage], self._memory[stage], self._limits, values, self._found, False)
        return float(self._found[0])

    def reset(self, stage: str) -> None:
        """Forget the rows of the checks before."""
        self._memory[stage][_KNOWN] = 0.0

    @classmethod
    def lesson(cls, flight: Series) -> Lesson:
        """The largest value of each relation in the flight, ``largest`` (relations,)."""
        largest = np.zeros(len(RELATIONS))
        for stage, checks in flight.checks.items():
            memory = np.zeros(_MEMORY)
            for index in range(len(checks)):
                values = checks.values[checks.rows(index)]
                measure(_KINDS[stage], memory, values, largest, np.zeros(len(RELATIONS)))
                remember(memory, values)
        return {"largest": largest}

    @classmethod
    def train(cls, lessons: Sequence[Lesson], seed: int) -> dict[str, Any]:  # noqa: ARG003 - nothing is drawn
        """The largest value of each relation over all flights, with the margin."""
        largest = np.max([lesson["largest"] for lesson in lessons], axis=0)
        margin = np.where(np.isin(np.arange(len(RELATIONS)), _EXACT), 1.0, MARGIN)
        limits = {name: float(limit) for (name, _), limit in zip(RELATIONS, margin * largest, strict=True)}
        return KinematicParameters(limits=limits).model_dump(mode="json")

    @classmethod
    def load(cls, parameters: Mapping[str, Any], *, learning: bool = True) -> Self:  # noqa: ARG003
        """Make a detector from :class:`KinematicParameters`."""
        return cls(KinematicParameters.model_validate(parameters))


@njit(cache=True)
def inspect(kind: int, memory: Floats, limits: Floats, values: Floats, found: Floats, accept: bool) -> None:
    """Judge a check: ``found`` becomes score, relation, row; if ``accept``, one that passes is remembered."""
    largest, rows = np.zeros(len(limits)), np.zeros(len(limits))
    measure(kind, memory, values, largest, rows)
    found[:] = 0.0
    for index in range(len(limits)):
        value = largest[index]
        if value == 0.0:
            continue
        score = value / limits[index] if limits[index] > 0.0 else np.inf
        if score > found[0]:
            found[0], found[1], found[2] = score, index, rows[index]
    if accept and found[0] <= LIMIT:
        remember(memory, values)


@njit(cache=True)
def remember(memory: Floats, values: Floats) -> None:
    """Keep the last row of a check, and that of the one before."""
    if len(values) == 0:
        return
    memory[_BEFORE:] = memory[_LAST:_BEFORE]
    row = values[-1, :_WIDEST]
    memory[_LAST : _LAST + len(row)] = row
    memory[_KNOWN] = min(memory[_KNOWN] + 1.0, 2.0)


@njit(cache=True)
def measure(kind: int, memory: Floats, values: Floats, largest: Floats, rows: Floats) -> None:
    """Raise ``largest`` to what a check shows, with the row where it does. NaN counts as infinite."""
    if kind == 0:
        _perception(memory, values[0], largest, rows)
    elif kind == 1:
        _planning(memory, values, largest, rows)
    else:
        _control(memory, values[0], values[1], largest, rows)


@njit(cache=True)
def _raise(largest: Floats, rows: Floats, relation: int, value: float, row: int) -> None:
    if not value <= largest[relation]:
        largest[relation] = value if value < np.inf else np.inf
        rows[relation] = row


@njit(cache=True)
def _size(values: Floats) -> float:
    return math.sqrt(values[0] ** 2 + values[1] ** 2 + values[2] ** 2)


@njit(cache=True)
def _perception(memory: Floats, check: Floats, largest: Floats, rows: Floats) -> None:
    """A time to collision is positive and not far; it begins with a collision that is counted."""
    left_s, collisions = check[0], check[1]
    found = left_s < np.inf
    if left_s != np.inf:
        _raise(largest, rows, _TTC, left_s if left_s >= 0.0 else np.inf, 0)
    if memory[_KNOWN] == 0.0:
        return
    step = collisions - memory[_LAST + 1]
    uncounted = step == 0.0 and found and not memory[_LAST] < np.inf
    groundless = step != 0.0 and not found
    _raise(largest, rows, _COLLISIONS, np.inf if step < 0.0 or uncounted or groundless else step, 0)


@njit(cache=True)
def _planning(memory: Floats, points: Floats, largest: Floats, rows: Floats) -> None:
    """Columns: t, x y z, vx vy vz, ax ay az, yaw, two sequence numbers."""
    for row in range(len(points)):
        now = points[row]
        _motion(now[1:10], largest, rows, row)
        _raise(largest, rows, _YAW, abs(now[10]), row)
        if row == 0:
            continue
        before = points[row - 1]
        duration = now[0] - before[0]
        _raise(largest, rows, _ROW_DURATION, duration, row)
        _raise(largest, rows, _ROWS_PER_S, 1.0 / duration if duration > 0.0 else np.inf, row)
        _agree(before[1:10], now[1:10], duration, largest, rows, row)
        turn = (now[10] - before[10] + math.pi) % (2.0 * math.pi) - math.pi
        _raise(largest, rows, _YAW_RATE, abs(turn / duration) if duration > 0.0 else np.inf, row)
    if len(points) and memory[_KNOWN] > 0.0:
        made, answered = points[0, 11] - memory[_LAST + 11], points[0, 12] - memory[_LAST + 12]
        _raise(largest, rows, _TRAJECTORY_SEQ, made if made > 0.0 else np.inf, 0)
        _raise(largest, rows, _ANSWERED, answered if answered >= 0.0 else np.inf, 0)


@njit(cache=True)
def _control(memory: Floats, behind: Floats, tick: Floats, largest: Floats, rows: Floats) -> None:
    """Columns: curve, duration, x y z, vx vy vz, ax ay az, command vx vy vz, yaw rate."""
    duration, waypoint, command, turn = tick[1], tick[2:11], tick[11:14], tick[14]
    _motion(waypoint, largest, rows, 0)
    _raise(largest, rows, _WAYPOINT_DURATION, duration if duration >= 0.0 else np.inf, 0)
    _raise(largest, rows, _COMMAND, _size(command), 0)
    _raise(largest, rows, _COMMAND_OFF, _size(command - waypoint[3:6]), 0)
    _raise(largest, rows, _TURN, abs(turn), 0)
    if (waypoint != behind[2:11]).any():
        _agree(behind[2:11], waypoint, duration, largest, rows, 0)
    last = memory[_LAST:_BEFORE]
    if memory[_KNOWN] == 0.0 or last[0] != tick[0]:
        return
    step = command - last[11:14]
    _raise(largest, rows, _COMMAND_STEP, _size(step), 0)
    _raise(largest, rows, _TURN_STEP, abs(turn - last[14]), 0)
    before = memory[_BEFORE:]
    if memory[_KNOWN] > 1.0 and before[0] == tick[0]:
        _raise(largest, rows, _COMMAND_BEND, _size(step - last[11:14] + before[11:14]), 0)


@njit(cache=True)
def _motion(point: Floats, largest: Floats, rows: Floats, row: int) -> None:
    _raise(largest, rows, _SPEED, _size(point[3:6]), row)
    _raise(largest, rows, _ACCELERATION, _size(point[6:9]), row)


@njit(cache=True)
def _agree(a: Floats, b: Floats, h: float, largest: Floats, rows: Floats, row: int) -> None:
    """The two relations between position, velocity and acceleration, axis by axis."""
    for axis in range(3):
        v0, v1, a0, a1 = a[3 + axis], b[3 + axis], a[6 + axis], b[6 + axis]
        moved = b[axis] - a[axis] - 0.5 * h * (v0 + v1) + h * h / 12.0 * (a1 - a0)
        _raise(largest, rows, _POSITION_OFF, abs(moved), row)
        _raise(largest, rows, _VELOCITY_OFF, abs(v1 - v0 - 0.5 * h * (a0 + a1)), row)
