"""AAD: one autoencoder over the changes of 13 states; an alarm where it fails to reproduce them (V-D).

It sits at control, as in the paper: it sees the waypoint that is tracked and the command made for it. The
change of each state is divided by the largest of the training flights and cubed: what was seen stays within
+-1, and one change beyond it outweighs several ordinary ones that meet by chance. The hidden layers bend
(softsign, x / (1 + |x|)) and are bounded, so a change far beyond what was learned cannot be reproduced; the
output is linear. Inference is compiled and needs no torch: :mod:`detector.schemes.network_training` does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from numba import njit
from pydantic import Field

from detector.schemes.base import LIMIT, Floats, Lesson
from detector.schemes.control_scheme import KNOWN, SCORE, STAGE, ControlScheme
from detector.schemes.layers import Layer, dense, packed
from detector.series.changes import changes
from detector.series.monitored_states import CURVE, DURATION, WATCHED
from detector.series.preprocessing import FLOORS, level
from detector.series.series import Series
from services.models.base import Strict

INPUTS = (
    *(f"trajectory.{name}" for name in ("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az")),
    *(f"command.v{axis}" for axis in "xyz"),
    DURATION,
)
"""The 13 (facts page, "Monitored inter-kernel states")."""

SIZES = (len(INPUTS), 6, 3, len(INPUTS))
MARGIN = 1.25
"""Of the threshold over the largest error of the training flights: other flights meet other chances."""

_COLUMNS = np.array([WATCHED[STAGE].index(name) for name in INPUTS])
_FLOORS = np.array([FLOORS[name] for name in INPUTS])
_COMMANDS = np.array([name.startswith("command.") for name in INPUTS])
_CURVE_COLUMN = WATCHED[STAGE].index(CURVE)

_Inputs = Annotated[list[float], Field(min_length=SIZES[0], max_length=SIZES[0])]


class AutoencoderParameters(Strict):
    """The largest change of each input, three layers, and the largest mean squared error that is no alarm."""

    scale: _Inputs
    layers: Annotated[list[Layer], Field(min_length=3, max_length=3)]
    threshold: float = Field(gt=0)

    def packed(self) -> Floats:
        """All numbers in one row, as the compiled network wants them.

        :raises ValueError: if a layer is of another shape.
        """
        return np.concatenate(((self.threshold,), self.scale, packed(self.layers, SIZES)))


class Autoencoder(ControlScheme):
    """The network at control, judged by its reconstruction error; it learns nothing in flight."""

    name: ClassVar[str] = "autoencoder"
    states: ClassVar[tuple[str, ...]] = INPUTS
    alarmed_row: ClassVar[int] = 0

    def __init__(self, parameters: AutoencoderParameters) -> None:
        super().__init__(parameters.packed(), _BEFORE + len(INPUTS))

    def _inspect(self, values: Floats, accept: bool) -> int:
        return int(inspect(self._memory, self._numbers, values, accept))

    @classmethod
    def lesson(cls, flight: Series) -> Lesson:
        """The distinct changes of a flight, ``changes`` (n, 13); how often one was seen does not count."""
        found = changes(STAGE, flight.checks[STAGE])
        rows = np.column_stack([found[name] for name in INPUTS]).astype(np.int16)
        return {"changes": np.unique(rows, axis=0)}

    @classmethod
    def train(cls, lessons: Sequence[Lesson], seed: int) -> dict[str, Any]:
        """Train with torch; the threshold is the compiled network's own largest error."""
        from detector.schemes.network_training import fit  # noqa: PLC0415 - torch is needed here only

        rows = np.unique(np.concatenate([lesson["changes"] for lesson in lessons]), axis=0).astype(np.float64)
        scale = np.maximum(np.abs(rows).max(axis=0), 1.0)
        seen = (rows / scale) ** 3
        layers = [Layer(weight=weight, bias=bias) for weight, bias in fit(seen, seen, SIZES, seed)]
        untried = AutoencoderParameters(scale=scale.tolist(), layers=layers, threshold=1.0)
        worst = largest_error(untried.packed(), rows)
        return untried.model_copy(update={"threshold": MARGIN * worst}).model_dump(mode="json")

    @classmethod
    def load(cls, parameters: Mapping[str, Any], *, learning: bool = True) -> Self:  # noqa: ARG003
        """Make a detector from :class:`AutoencoderParameters`."""
        return cls(AutoencoderParameters.model_validate(parameters))


# What is remembered besides: the curve, the input that is reproduced worst, the levels of the tick before.
_KNOWN, _SCORE, _CURVE, _WORST, _BEFORE = KNOWN, SCORE, 2, 3, 4
_IN, _HIDDEN, _CODE, _ = SIZES
_SCALE = 1
_LAYERS = _SCALE + _IN


@njit(cache=True)
def inspect(memory: Floats, network: Floats, values: Floats, accept: bool) -> int:
    """Judge a tick: the input that is reproduced worst, -1 if the error is within the threshold.

    The score is left in ``memory``; if ``accept``, a tick that passes becomes the predecessor of the next.
    """
    bits = values.view(np.int64)
    compared = memory[_KNOWN] != 0.0 and values[1, _CURVE_COLUMN] == memory[_CURVE]
    now, change = np.empty(_IN), np.zeros(_IN)
    for index in range(_IN):
        column, floor = _COLUMNS[index], _FLOORS[index]
        now[index] = level(bits[1, column], values[1, column], floor, False, 0)
        if not _COMMANDS[index]:
            change[index] = now[index] - level(bits[0, column], values[0, column], floor, False, 0)
        elif compared:
            change[index] = now[index] - memory[_BEFORE + index]
    memory[_SCORE] = _error(memory, network, change) / network[0]
    if memory[_SCORE] > LIMIT:
        return int(memory[_WORST])
    if accept:
        memory[_BEFORE:] = now
        memory[_KNOWN], memory[_CURVE] = 1.0, values[1, _CURVE_COLUMN]
    return -1


@njit(cache=True)
def _error(memory: Floats, network: Floats, change: Floats) -> float:
    """Mean squared error of one row of changes; the worst input is left in ``memory``."""
    seen = np.empty(_IN)
    for index in range(_IN):
        seen[index] = (change[index] / network[_SCALE + index]) ** 3
    hidden, at = dense(network, _LAYERS, seen, _HIDDEN, True)
    code, at = dense(network, at, hidden, _CODE, True)
    made, _ = dense(network, at, code, _IN, False)
    squares, worst = 0.0, -1.0
    for index in range(_IN):
        off = (made[index] - seen[index]) ** 2
        squares += off
        if off > worst:
            worst = off
            memory[_WORST] = index
    return squares / _IN


@njit(cache=True)
def largest_error(network: Floats, rows: Floats) -> float:
    """Over rows (n, 13) of changes."""
    memory, largest = np.zeros(_BEFORE), 0.0
    for row in rows:
        largest = max(largest, _error(memory, network, row))
    return largest
