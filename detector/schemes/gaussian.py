"""GAD: a Gaussian for each state's change; an alarm beyond n standard deviations (the paper, section V-C)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numba import njit
from pydantic import Field

from detector.schemes.base import LIMIT, Alarm, Floats, Lesson, Scheme
from detector.series.changes import CARRIED, changes
from detector.series.monitored_states import CURVE, WATCHED
from detector.series.preprocessing import FLOORS, FORMS, NONE_IS_ZERO, level
from detector.series.series import Series
from services.models.base import Strict

MONITORED: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "perception": WATCHED["perception"],
        "planning": WATCHED["planning"],
        "control": tuple(name for name in WATCHED["control"] if name.startswith("command.")),
    }
)
"""The states with a Gaussian, by stage (facts page, "Monitored inter-kernel states")."""

MARGIN = 0.5
"""Of a level, beyond the largest change of the training flights: where n is put. So the next whole change is
an alarm, and what was seen once is none even if the deviation shrinks a little in flight."""

RAW_MARGIN = 0.1
"""The same for raw changes, as a part of the largest one: they are no whole numbers."""

# A row of a stage's table: what a column is, and its Gaussian.
_COLUMN, _FLOOR, _NONE, _CARRIED, _COUNT, _MEAN, _SQUARES, _SIGMAS, _LAST = range(9)
# Its first row: what is remembered of the check before, and what was found.
_KNOWN, _CURVE, _KIND, _SCORE, _ROW, _FORM = range(6)
_KINDS = {"perception": 0, "planning": 1, "control": 2}
_SCORE_ONLY, _CHECK, _LEARN = 0, 1, 2


class StateGaussian(Strict):
    """A Gaussian: k, M_k and S_k of equations 1 and 2, and n."""

    count: int = Field(ge=2)
    mean: float
    squares: float = Field(ge=0)
    sigmas: float = Field(gt=0)


class GaussianParameters(Strict):
    """A Gaussian for each monitored state."""

    form: Literal["folded", "naive", "raw"] = "folded"
    states: dict[str, StateGaussian]


class Gaussian(Scheme):
    """One Gaussian a state, alarms gathered per stage, learning online."""

    name: ClassVar[str] = "gaussian"
    form: ClassVar[str] = "folded"

    def __init__(self, parameters: GaussianParameters, *, learning: bool = True) -> None:
        expected = [name for names in MONITORED.values() for name in names]
        if sorted(parameters.states) != sorted(expected):
            message = "not the Gaussians of the states that are monitored"
            raise ValueError(message)
        self._mode = _LEARN if learning else _CHECK
        self._tables = {stage: _table(stage, parameters) for stage in MONITORED}

    def check(self, stage: str, values: Floats) -> Alarm | None:
        """Judge a check, then learn from it if it passed."""
        table = self._tables[stage]
        found = inspect(table, values, self._mode)
        if found < 0:
            return None
        return Alarm(stage, MONITORED[stage][found], int(table[0, _ROW]), float(table[0, _SCORE]))

    def score(self, stage: str, values: Floats) -> float:
        """The largest distance from a mean, in units of n standard deviations."""
        table = self._tables[stage]
        inspect(table, values, _SCORE_ONLY)
        return float(table[0, _SCORE])

    def reset(self, stage: str) -> None:
        """Forget the levels of the check before."""
        self._tables[stage][0, _KNOWN] = 0.0

    def learned(self, state: str) -> tuple[int, float, float]:
        """Samples, mean and standard deviation of a state's change as they stand now."""
        stage = next(stage for stage, names in MONITORED.items() if state in names)
        row = self._tables[stage][1 + MONITORED[stage].index(state)]
        return int(row[_COUNT]), float(row[_MEAN]), math.sqrt(row[_SQUARES] / (row[_COUNT] - 1))

    @classmethod
    def lesson(cls, flight: Series) -> Lesson:
        """The changes of every monitored state."""
        kind = np.float64 if cls.form == "raw" else np.int16
        return {
            name: change.astype(kind)
            for stage, names in MONITORED.items()
            for name, change in changes(stage, flight.checks[stage], cls.form).items()
            if name in names
        }

    @classmethod
    def train(cls, lessons: Sequence[Lesson], seed: int) -> dict[str, Any]:  # noqa: ARG003 - nothing is drawn
        """Run the recurrences over all changes, and put n beyond the largest."""
        states = {}
        for names in MONITORED.values():
            for name in names:
                samples = np.concatenate([lesson[name] for lesson in lessons]).astype(np.float64)
                states[name] = _fit(name, samples, cls.form)
        parameters = GaussianParameters.model_validate({"form": cls.form, "states": states})
        return parameters.model_dump(mode="json")

    @classmethod
    def load(cls, parameters: Mapping[str, Any], *, learning: bool = True) -> Self:
        """Make a detector from :class:`GaussianParameters`."""
        return cls(GaussianParameters.model_validate(parameters), learning=learning)


class NaiveGaussian(Gaussian):
    """The same over sign and exponent bits as they stand: an ablation."""

    name: ClassVar[str] = "gaussian-naive"
    form: ClassVar[str] = "naive"


class RawGaussian(Gaussian):
    """The same over the values themselves, as in the authors' code: an ablation."""

    name: ClassVar[str] = "gaussian-raw"
    form: ClassVar[str] = "raw"


def _fit(name: str, samples: Floats, form: str) -> dict[str, float]:
    if len(samples) < 2:
        message = f"{name}: {len(samples)} changes in all flights are too few to learn from"
        raise ValueError(message)
    count, mean, squares = welford(0, 0.0, 0.0, samples)
    largest = float(np.abs(samples - mean).max())
    margin = RAW_MARGIN * largest if form == "raw" else MARGIN
    # What never changed in training may change a little: a rounded number's variance is 1/12.
    squares = squares or (count - 1) / 12.0
    fitted = (largest + margin or MARGIN) / math.sqrt(squares / (count - 1))
    return {"count": count, "mean": mean, "squares": squares, "sigmas": fitted}


def _table(stage: str, parameters: GaussianParameters) -> Floats:
    table = np.zeros((1 + len(MONITORED[stage]), 9))
    table[0, _KIND], table[0, _FORM] = _KINDS[stage], FORMS[parameters.form]
    for row, name in zip(table[1:], MONITORED[stage], strict=True):
        state = parameters.states[name]
        row[_COLUMN], row[_FLOOR] = WATCHED[stage].index(name), FLOORS[name]
        row[_NONE], row[_CARRIED] = name in NONE_IS_ZERO, name in CARRIED
        row[_COUNT], row[_MEAN] = state.count, state.mean
        row[_SQUARES], row[_SIGMAS] = state.squares, state.sigmas
    return table


@njit(cache=True)
def welford(count: int, mean: float, squares: float, samples: Floats) -> tuple[int, float, float]:
    """k, M_k and S_k after ``samples`` (equations 1 and 2; M_1 = x_1, S_1 = 0)."""
    for sample in samples:
        count += 1
        before = mean
        mean += (sample - before) / count
        squares += (sample - before) * (sample - mean)
    return count, mean, squares


_CURVE_COLUMN = WATCHED["control"].index(CURVE)


@njit(cache=True)
def inspect(table: Floats, values: Floats, mode: int) -> int:
    """Judge a check: the monitored state that is farthest beyond its limit, -1 if none is.

    The score and its row are left in the table's first row; unless ``mode`` is ``_SCORE_ONLY``, a check that
    passes becomes the predecessor of the next.
    """
    head, bits, form = table[0], values.view(np.int64), int(table[0, _FORM])
    begin = 1 if head[_KIND] == 2.0 else 0
    fresh = head[_KIND] == 1.0 or (begin == 1 and values[1, _CURVE_COLUMN] != head[_CURVE])
    worst, found, where = 0.0, -1, 0
    for index in range(1, len(table)):
        state = table[index]
        column, floor, none = int(state[_COLUMN]), int(state[_FLOOR]), state[_NONE] != 0.0
        carried = state[_CARRIED] != 0.0
        before = state[_LAST]
        known = head[_KNOWN] != 0.0 and (carried or not fresh)
        for row in range(begin, min(len(values), 1) if carried else len(values)):
            now = level(bits[row, column], values[row, column], floor, none, form)
            if known:
                off = now - before - state[_MEAN]
                spread = state[_SIGMAS] * state[_SIGMAS] * state[_SQUARES]
                score = off * off * (state[_COUNT] - 1.0)
                if spread > 0.0:
                    score /= spread
                elif off != 0.0:
                    score = np.inf
                if score > worst:
                    worst, found, where = score, index - 1, row
            before, known = now, True
    head[_SCORE], head[_ROW] = math.sqrt(worst), where
    if head[_SCORE] > LIMIT:
        return found
    if mode != _SCORE_ONLY and len(values):
        _accept(table, values, fresh, mode)
    return -1


@njit(cache=True)
def _accept(table: Floats, values: Floats, fresh: bool, mode: int) -> None:
    head, bits, form = table[0], values.view(np.int64), int(table[0, _FORM])
    begin = 1 if head[_KIND] == 2.0 else 0
    for index in range(1, len(table)):
        state = table[index]
        column, floor, none = int(state[_COLUMN]), int(state[_FLOOR]), state[_NONE] != 0.0
        carried = state[_CARRIED] != 0.0
        known = mode == _LEARN and head[_KNOWN] != 0.0 and (carried or not fresh)
        before = state[_LAST]
        for row in range(begin, min(len(values), 1) if carried else len(values)):
            now = level(bits[row, column], values[row, column], floor, none, form)
            if known:
                change = now - before
                mean = state[_MEAN]
                state[_COUNT] += 1.0
                state[_MEAN] += (change - mean) / state[_COUNT]
                state[_SQUARES] += (change - mean) * (change - state[_MEAN])
            before, known = now, mode == _LEARN
        state[_LAST] = before
    head[_KNOWN] = 1.0
    if begin == 1:
        head[_CURVE] = values[1, _CURVE_COLUMN]
