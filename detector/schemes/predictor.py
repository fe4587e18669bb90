"""A network predicts each command from what control had; the limit comes with a promise (conformal).

What it had: the tracked waypoint and the row behind it, relative to where the vehicle is, the velocity that
was measured, and the command of the tick before. The error of a tick is that of its worst component, in
deviations of the training; that of a flight is its largest. Half of the training flights teach the network,
the other n calibrate: the limit is the k-th smallest of their errors, k = ceil((n + 1) (1 - RATE)). Another
flight of the same kind then has an alarm with a probability of at most RATE, however errors are distributed
(split conformal prediction; Vovk, Gammerman and Shafer 2005, section 4.2).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from numba import njit
from pydantic import Field

from detector.schemes.base import LIMIT, Floats, Lesson
from detector.schemes.control_scheme import KNOWN, SCORE, STAGE, ControlScheme
from detector.schemes.layers import Layer, dense, packed
from detector.series.monitored_states import DURATION, WATCHED
from detector.series.series import Series
from services.models.base import Strict

OUTPUTS = ("command.vx", "command.vy", "command.vz")
SIZES = (23, 24, 12, len(OUTPUTS))
_IN, _FIRST, _SECOND, _OUT = SIZES

RATE = 0.1
"""Of flights without a fault, how many may have an alarm: promised, at most."""

_EVERY = 4  # ticks of a flight that teaches: its neighbours say the same
_TICK_S = 0.04
_LONGEST_S = 1.0

_Positive = Annotated[float, Field(gt=0)]


class PredictorParameters(Strict):
    """What inputs and errors are divided by, three layers, and the largest error that is no alarm."""

    scale: Annotated[list[_Positive], Field(min_length=_IN, max_length=_IN)]
    deviation: Annotated[list[_Positive], Field(min_length=_OUT, max_length=_OUT)]
    layers: Annotated[list[Layer], Field(min_length=3, max_length=3)]
    threshold: _Positive

    def numbers(self) -> Floats:
        """All numbers in one row, as the compiled network wants them."""
        return np.concatenate(((self.threshold,), self.scale, self.deviation, packed(self.layers, SIZES)))


class Predictor(ControlScheme):
    """The network at control, judged by the error of its worst component; it learns nothing in flight."""

    name: ClassVar[str] = "predictor"
    states: ClassVar[tuple[str, ...]] = OUTPUTS

    def __init__(self, parameters: PredictorParameters) -> None:
        super().__init__(parameters.numbers(), _MEMORY)

    def _inspect(self, values: Floats, accept: bool) -> int:
        return int(inspect(self._memory, self._numbers, values, accept))

    @classmethod
    def lesson(cls, flight: Series) -> Lesson:
        """Of all ticks but the first what control had, ``inputs`` (n, 23), and made, ``wanted`` (n, 3)."""
        checks = flight.checks[STAGE]
        memory, inputs, wanted = np.zeros(_MEMORY), [], []
        for index in range(len(checks)):
            values = checks.values[checks.rows(index)]
            if memory[_KNOWN]:
                inputs.append(had(memory, values))
                wanted.append(made(values[1]))
            remember(memory, values)
        return {
            "inputs": np.array(inputs, dtype=np.float32).reshape(-1, _IN),
            "wanted": np.array(wanted, dtype=np.float32).reshape(-1, _OUT),
        }

    @classmethod
    def train(cls, lessons: Sequence[Lesson], seed: int) -> dict[str, Any]:
        """Teach the network by each other flight; put the threshold by those between, as was promised.

        :raises ValueError: if there are too few flights for the promise.
        """
        from detector.schemes.network_training import fit  # noqa: PLC0415 - torch is needed here only

        teaching, calibrating = lessons[::2], lessons[1::2]
        rank = conformal_rank(len(calibrating))
        rows, wanted = (
            np.concatenate([one[name][::_EVERY] for one in teaching]).astype(np.float64)
            for name in ("inputs", "wanted")
        )
        scale = np.maximum(np.abs(rows).max(axis=0), 1e-3)
        largest = np.maximum(np.abs(wanted).max(axis=0), 1e-3)
        *layers, last = fit(rows / scale, wanted / largest, SIZES, seed)
        weight, bias = (np.array(one).T * largest for one in last)  # so that it makes m/s
        layers.append((weight.T.tolist(), bias.tolist()))
        untried = PredictorParameters(
            scale=scale.tolist(),
            deviation=[1.0] * _OUT,
            layers=[Layer(weight=one, bias=other) for one, other in layers],
            threshold=1.0,
        )
        off = np.concatenate([errors(untried.numbers(), one) for one in teaching])
        scaled = untried.model_copy(update={"deviation": np.maximum(off.std(axis=0), 1e-6).tolist()})
        worst = sorted(float(np.abs(errors(scaled.numbers(), one)).max(initial=1e-9)) for one in calibrating)
        return scaled.model_copy(update={"threshold": worst[rank - 1]}).model_dump(mode="json")

    @classmethod
    def load(cls, parameters: Mapping[str, Any], *, learning: bool = True) -> Self:  # noqa: ARG003
        """Make a detector from :class:`PredictorParameters`."""
        return cls(PredictorParameters.model_validate(parameters))


def conformal_rank(flights: int) -> int:
    """Which of the errors of so many flights, the smallest first, is the limit that keeps ``RATE``.

    :raises ValueError: if so few flights cannot promise it.
    """
    rank = math.ceil((flights + 1) * (1.0 - RATE))
    if rank > flights:
        least = math.ceil((1.0 - RATE) / RATE)
        message = f"{flights} flights calibrate, at least {least} are needed: twice as many in all"
        raise ValueError(message)
    return rank


_DURATION = WATCHED[STAGE].index(DURATION)
_WAYPOINT, _COMMAND = (WATCHED[STAGE].index(name) for name in ("trajectory.x", "command.vx"))
_TURN, _MEASURED = (WATCHED[STAGE].index(name) for name in ("command.yaw_rate", "odometry.x"))

# What is remembered besides: the command of the tick before, its waypoint and since when.
_KNOWN, _SCORE, _LAST_COMMAND, _LAST_WAYPOINT, _SINCE = KNOWN, SCORE, 2, 5, 8
_MEMORY = _SINCE + 1

# The numbers of a model.
_THRESHOLD, _SCALE = 0, 1
_DEVIATION = _SCALE + _IN
_LAYERS = _DEVIATION + _OUT


@njit(cache=True)
def inspect(memory: Floats, numbers: Floats, values: Floats, accept: bool) -> int:
    """Judge a check: the component of the command that is farthest off, -1 if all are near enough.

    The score is left in ``memory``; if ``accept``, a tick that passes becomes the predecessor of the next.
    """
    memory[_SCORE], found = 0.0, -1
    if not np.isfinite(values).all():
        memory[_SCORE], found = np.inf, 0
    elif memory[_KNOWN] != 0.0:
        off = _error(numbers, had(memory, values), made(values[1]))
        for index in range(_OUT):
            score = abs(off[index]) / numbers[_THRESHOLD]
            if score > memory[_SCORE]:
                memory[_SCORE], found = score, index
    if memory[_SCORE] > LIMIT:
        return found
    if accept:
        remember(memory, values)
    return -1


@njit(cache=True)
def had(memory: Floats, values: Floats) -> Floats:
    """What control had at a tick (23,): relative to where the vehicle is, m, s, world frame."""
    behind, tick = values[0], values[1]
    inputs = np.empty(_IN)
    inputs[0] = min(tick[_DURATION], _LONGEST_S)
    inputs[1] = min(_since(memory, tick), _LONGEST_S)
    for axis in range(3):
        here = tick[_MEASURED + axis]
        inputs[2 + axis] = behind[_WAYPOINT + axis] - here
        inputs[5 + axis] = tick[_WAYPOINT + axis] - here
        inputs[8 + axis] = behind[_WAYPOINT + 3 + axis] - tick[_WAYPOINT + 3 + axis]
        inputs[11 + axis] = tick[_WAYPOINT + 3 + axis]
        inputs[14 + axis] = tick[_WAYPOINT + 6 + axis]
        inputs[17 + axis] = tick[_MEASURED + 3 + axis] - tick[_WAYPOINT + 3 + axis]
        inputs[20 + axis] = memory[_LAST_COMMAND + axis] - tick[_WAYPOINT + 3 + axis]
    return inputs


@njit(cache=True)
def made(tick: Floats) -> Floats:
    """The velocity that a tick commands, less that of its waypoint (3,), in m/s."""
    return tick[_COMMAND:_TURN] - tick[_WAYPOINT + 3 : _WAYPOINT + 6]


@njit(cache=True)
def _since(memory: Floats, tick: Floats) -> float:
    """For how long the waypoint of a tick is flown to, in s."""
    for axis in range(3):
        if tick[_WAYPOINT + axis] != memory[_LAST_WAYPOINT + axis]:
            return 0.0
    return float(memory[_SINCE] + _TICK_S)


@njit(cache=True)
def remember(memory: Floats, values: Floats) -> None:
    """Make a check the predecessor of the next."""
    tick = values[1]
    memory[_SINCE] = _since(memory, tick)
    memory[_LAST_COMMAND : _LAST_COMMAND + 3] = tick[_COMMAND:_TURN]
    memory[_LAST_WAYPOINT : _LAST_WAYPOINT + 3] = tick[_WAYPOINT : _WAYPOINT + 3]
    memory[_KNOWN] = 1.0


@njit(cache=True)
def _error(numbers: Floats, inputs: Floats, wanted: Floats) -> Floats:
    """By how many deviations what was commanded differs from what is predicted (3,)."""
    first, at = dense(numbers, _LAYERS, inputs / numbers[_SCALE:_DEVIATION], _FIRST, True)
    second, at = dense(numbers, at, first, _SECOND, True)
    predicted, _ = dense(numbers, at, second, _OUT, False)
    return (wanted - predicted) / numbers[_DEVIATION:_LAYERS]


def errors(numbers: Floats, lesson: Lesson) -> Floats:
    """Of all ticks of a lesson (n, 3)."""
    rows, wanted = lesson["inputs"].astype(np.float64), lesson["wanted"].astype(np.float64)
    return np.array([_error(numbers, *one) for one in zip(rows, wanted, strict=True)]).reshape(-1, _OUT)
