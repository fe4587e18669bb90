"""Small networks as models hold them and flights run them: dense layers, compiled, without torch."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numba import njit

from detector.schemes.base import Floats
from services.models.base import Strict


class Layer(Strict):
    """``weight`` (outputs, inputs) and ``bias`` (outputs,)."""

    weight: list[list[float]]
    bias: list[float]


def packed(layers: Sequence[Layer], sizes: Sequence[int]) -> Floats:
    """All numbers of layers in one row, as :func:`dense` wants them: of each the weights, then the biases.

    :raises ValueError: if a layer is of another shape than ``sizes``, inputs first, say.
    """
    parts = []
    for layer, (inputs, outputs) in zip(layers, pairwise(sizes), strict=True):
        shapes = [len(layer.weight), *sorted({len(row) for row in layer.weight}), len(layer.bias)]
        if shapes != [outputs, inputs, outputs]:
            message = f"a layer is not {inputs} to {outputs}: the network is {'-'.join(map(str, sizes))}"
            raise ValueError(message)
        parts += [np.array(layer.weight).ravel(), np.array(layer.bias)]
    return np.concatenate(parts)


@njit(cache=True)
def dense(numbers: Floats, at: int, seen: Floats, outputs: int, bent: bool) -> tuple[Floats, int]:
    """What a layer makes of ``seen``: its numbers begin at ``at``; and where those of the next one do.

    ``bent``: by softsign, x / (1 + |x|).
    """
    made, inputs = np.empty(outputs), len(seen)
    biases = at + inputs * outputs
    for unit in range(outputs):
        total = numbers[biases + unit]
        for index in range(inputs):
            total += numbers[at + unit * inputs + index] * seen[index]
        made[unit] = total / (1.0 + abs(total)) if bent else total
    return made, biases + outputs
