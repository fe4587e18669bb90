"""Physical invariants: what odometry measures must follow from what the vehicle was commanded.

The vehicle answers a velocity command u as a linear system whose coefficients are learned (per axis, the
last three velocities v and commands, ticks of 40 ms):

    v' = sum_i (a_i v_i + b_i u_i),    p' = p + T/2 (v + v').

The innovation of a tick is the measured velocity and position minus these predictions: that of a Kalman
filter whose measurements are exact, so that its gain is 1. Divided by its deviation in training it is z (6,).
Two sums are judged (after SAVIOR, Quinonez et al., USENIX Security 2020): z^T z, the chi-square test of one
tick, and for each component Page's two-sided CUSUM, S = max(0, S +- z - K), in which what is too small for
one tick adds up: a weak motor, a slow drift. A limit is the largest value of the training flights times a
margin.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from numba import njit
from pydantic import Field

from detector.schemes.base import LIMIT, Floats, Lesson
from detector.schemes.control_scheme import KNOWN, SCORE, STAGE, ControlScheme
from detector.series.monitored_states import WATCHED
from detector.series.series import Series
from services.models.base import Strict

STATES = ("odometry.vx", "odometry.vy", "odometry.vz", "odometry.x", "odometry.y", "odometry.z")
"""What the innovation consists of; an alarm names its worst component."""

MARGIN = 1.5
"""Of a limit over the largest value of the training flights."""

_TICK_S = 0.04
_ORDER = 3  # ticks of which the velocity of the next one is made
_SLACK = 0.5  # Page's K: a shift of the mean of twice that, in deviations, is found soonest
_SIZE = len(STATES)

_Positive = Annotated[list[Annotated[float, Field(gt=0)]], Field(min_length=_SIZE, max_length=_SIZE)]
_Coefficients = Annotated[list[float], Field(min_length=2 * _ORDER, max_length=2 * _ORDER)]


class PhysicalParameters(Strict):
    """The response of each axis, a_1 a_2 a_3 b_1 b_2 b_3, the newest first; what is normal of its innovation.

    ``mean`` and ``deviation`` of each component; the limits ``largest_square`` of z^T z and
    ``largest_sums`` of each component's CUSUM.
    """

    response: Annotated[list[_Coefficients], Field(min_length=3, max_length=3)]
    mean: Annotated[list[float], Field(min_length=_SIZE, max_length=_SIZE)]
    deviation: _Positive
    largest_square: float = Field(gt=0)
    largest_sums: _Positive

    def packed(self) -> Floats:
        """All numbers in one row, as the compiled test wants them."""
        limits = ((self.largest_square,), self.largest_sums)
        return np.concatenate((*limits, self.mean, self.deviation, *self.response))


class Physical(ControlScheme):
    """Watches the vehicle's response at control, by the larger of both sums; learns nothing in flight."""

    name: ClassVar[str] = "physical"
    states: ClassVar[tuple[str, ...]] = STATES

    def __init__(self, parameters: PhysicalParameters) -> None:
        super().__init__(parameters.packed(), _MEMORY)

    def _inspect(self, values: Floats, accept: bool) -> int:
        return int(inspect(self._memory, self._numbers, values[1, _TICK], accept))

    @classmethod
    def lesson(cls, flight: Series) -> Lesson:
        """Command and odometry of each tick, ``ticks`` (n, 10)."""
        return {"ticks": flight.checks[STAGE].values[1::2, _TICK].astype(np.float32)}

    @classmethod
    def train(cls, lessons: Sequence[Lesson], seed: int) -> dict[str, Any]:  # noqa: ARG003 - nothing is drawn
        """Fit the response by least squares; put both limits beyond the largest sums of the flights."""
        flights = [lesson["ticks"].astype(np.float64) for lesson in lessons]
        response = np.array([_response(flights, axis) for axis in range(3)])
        off = np.concatenate([_innovations(ticks, response) for ticks in flights])
        made = PhysicalParameters(
            response=response.tolist(),
            mean=off.mean(axis=0).tolist(),
            deviation=off.std(axis=0).tolist(),
            largest_square=1.0,
            largest_sums=[1.0] * _SIZE,
        )
        largest = np.max([_largest(made.packed(), ticks) for ticks in flights], axis=0) * MARGIN
        limits = {"largest_square": float(largest[0]), "largest_sums": largest[1:].tolist()}
        return made.model_copy(update=limits).model_dump(mode="json")

    @classmethod
    def load(cls, parameters: Mapping[str, Any], *, learning: bool = True) -> Self:  # noqa: ARG003
        """Make a detector from :class:`PhysicalParameters`."""
        return cls(PhysicalParameters.model_validate(parameters))


# A tick: command (3) and yaw rate, position (3), velocity (3).
_TICK = slice(WATCHED[STAGE].index("command.vx"), WATCHED[STAGE].index("odometry.vz") + 1)
_U, _P, _V = 0, 4, 7

# What is remembered besides: velocities and commands, the newest first; position, sums.
_KNOWN, _SCORE, _VELOCITIES = KNOWN, SCORE, 2
_COMMANDS = _VELOCITIES + 3 * _ORDER
_LAST_POSITION = _COMMANDS + 3 * _ORDER
_SUMS = _LAST_POSITION + 3
_MEMORY = _SUMS + 2 * _SIZE

# The numbers of a model: the limits, mean, deviation, the response.
_SQUARE_LIMIT, _SUM_LIMITS = 0, 1
_MEAN = _SUM_LIMITS + _SIZE
_DEVIATION = _MEAN + _SIZE
_RESPONSE = _DEVIATION + _SIZE


@njit(cache=True)
def inspect(memory: Floats, numbers: Floats, tick: Floats, accept: bool) -> int:
    """Judge a tick (10,): the worst component of its innovation, -1 if both sums are within their limits.

    The score is left in ``memory``; if ``accept``, a tick that passes becomes the predecessor of the next.
    """
    sums = memory[_SUMS:].copy()
    memory[_SCORE], found = 0.0, -1
    if not np.isfinite(tick).all():
        memory[_SCORE], found = np.inf, 0
    elif memory[_KNOWN] >= _ORDER:
        found = _add(memory, numbers, tick, sums)
    if memory[_SCORE] > LIMIT:
        return found
    if accept:
        _remember(memory, tick)
        memory[_SUMS:] = sums
    return -1


@njit(cache=True)
def _add(memory: Floats, numbers: Floats, tick: Floats, sums: Floats) -> int:
    """Add a tick to the ``sums`` (12,); its worst component. The score is left in ``memory``."""
    off = innovation(memory, numbers, tick)
    square, worst, found, score = 0.0, -1.0, -1, 0.0
    for index in range(_SIZE):
        z = (off[index] - numbers[_MEAN + index]) / numbers[_DEVIATION + index]
        square += z * z
        for sign, at in ((1.0, 2 * index), (-1.0, 2 * index + 1)):
            sums[at] = max(0.0, sums[at] + sign * z - _SLACK)
            share = sums[at] / numbers[_SUM_LIMITS + index]
            score = max(score, share)
            share = max(share, z * z / numbers[_SQUARE_LIMIT])
            if share > worst:
                worst, found = share, index
    memory[_SCORE] = max(score, square / numbers[_SQUARE_LIMIT])
    return found


@njit(cache=True)
def innovation(memory: Floats, numbers: Floats, tick: Floats) -> Floats:
    """What was measured less what was predicted (6,): velocity in m/s, then position in m."""
    off = np.empty(_SIZE)
    for axis in range(3):
        predicted = 0.0
        for age in range(_ORDER):
            at, of = _RESPONSE + 2 * _ORDER * axis + age, 3 * age + axis
            predicted += numbers[at] * memory[_VELOCITIES + of]
            predicted += numbers[at + _ORDER] * memory[_COMMANDS + of]
        off[axis] = tick[_V + axis] - predicted
        moved = 0.5 * _TICK_S * (memory[_VELOCITIES + axis] + tick[_V + axis])
        off[3 + axis] = tick[_P + axis] - memory[_LAST_POSITION + axis] - moved
    return off


@njit(cache=True)
def _remember(memory: Floats, tick: Floats) -> None:
    memory[_VELOCITIES + 3 : _COMMANDS] = memory[_VELOCITIES : _COMMANDS - 3].copy()
    memory[_COMMANDS + 3 : _LAST_POSITION] = memory[_COMMANDS : _LAST_POSITION - 3].copy()
    memory[_VELOCITIES : _VELOCITIES + 3] = tick[_V : _V + 3]
    memory[_COMMANDS : _COMMANDS + 3] = tick[_U : _U + 3]
    memory[_LAST_POSITION:_SUMS] = tick[_P : _P + 3]
    memory[_KNOWN] = min(memory[_KNOWN] + 1.0, _ORDER)


def _response(flights: Sequence[Floats], axis: int) -> Floats:
    """The coefficients (6,) by which an axis's velocity follows best from those before and the commands."""
    columns = [(at, age) for at in (_V + axis, _U + axis) for age in range(_ORDER)]
    before = [
        np.column_stack([ticks[_ORDER - 1 - age : -1 - age, at] for at, age in columns]) for ticks in flights
    ]
    after = np.concatenate([ticks[_ORDER:, _V + axis] for ticks in flights])
    fitted: Floats = np.linalg.lstsq(np.concatenate(before), after, rcond=None)[0]
    return fitted


def _innovations(ticks: Floats, response: Floats) -> Floats:
    """Of each tick of a flight that has enough before it (n, 6)."""
    numbers = np.concatenate((np.ones(_RESPONSE), response.ravel()))
    memory, found = np.zeros(_MEMORY), []
    for tick in ticks:
        if memory[_KNOWN] >= _ORDER:
            found.append(innovation(memory, numbers, tick))
        _remember(memory, tick)
    return np.array(found)


def _largest(numbers: Floats, ticks: Floats) -> Floats:
    """The largest z^T z of a flight and the largest sum of each component (7,)."""
    mean, deviation = numbers[_MEAN:_DEVIATION], numbers[_DEVIATION:_RESPONSE]
    z = (_innovations(ticks, numbers[_RESPONSE:]) - mean) / deviation
    largest, sums = np.zeros(_SIZE), np.zeros((2, _SIZE))
    for one in z:
        sums = np.maximum(0.0, sums + np.array((one, -one)) - _SLACK)
        largest = np.maximum(largest, sums.max(axis=0))
    return np.array([(z * z).sum(axis=1).max(), *largest])
