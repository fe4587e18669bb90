"""The fault models as arithmetic: which bits may be drawn, and what becomes of a value."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import TypeVar

import numpy as np

from services.models.faults.mask_histogram import MaskHistogram
from services.models.faults.specification import FaultSpec

MANTISSA_BITS = {32: 23, 64: 52}  # IEEE 754 binary32 and binary64
ALIGNED_BITS = {"byte": 8, "word": 32}
"""Widths of the aligned parts of which a mask of that kind strikes one."""

_Key = TypeVar("_Key", int, str)


def groups(
    fault: FaultSpec, width_bits: int, element_bits: int = 0, accessed: Sequence[int] = ()
) -> list[Sequence[int]]:
    """The sets of bits of which the fault draws one, and then its bits within; empty if none has enough.

    One set for ``field`` any: all bits that are accessed. Else one for each number in the operand: the
    field's bits of that number. ``bit_numbers`` are a set of their own, if the operand has all of them.
    With ``mask`` byte or word, one for each aligned part: the bits of it that are accessed. With a histogram
    that names bits, one for each number in the operand, or the operand if it holds none.
    """
    every: Sequence[int] = accessed or range(width_bits)
    if fault.bit_numbers is not None:
        return [fault.bit_numbers] if set(fault.bit_numbers) <= set(every) else []
    named = fault.named_bits
    if fault.mask in ALIGNED_BITS:
        found = _aligned(every, ALIGNED_BITS[fault.mask])
    elif fault.field == "any" and not (named and element_bits):
        found = [every]
    elif not element_bits:
        found = []
    else:
        found = [
            range(lane + bounds[0], lane + bounds[1])
            for bounds in [_field(fault.field, element_bits)]
            for lane in range(0, width_bits, element_bits)
        ]
    return [bits for bits in found if len(bits) >= fault.most_bits and _has(bits, named)]


def _aligned(bits: Sequence[int], width: int) -> list[Sequence[int]]:
    """``bits``, which rise, in sets of those that are in one aligned part of that ``width``."""
    if isinstance(bits, range):
        return [bits[start : start + width] for start in range(0, len(bits), width)]
    return [tuple(part) for _, part in groupby(bits, lambda bit: bit // width)]


def _start(bits: Sequence[int]) -> int:
    """The bit from which a histogram counts: of one number in an operand its lowest, else the operand's."""
    return bits.start if isinstance(bits, range) else 0


def _has(bits: Sequence[int], named: frozenset[int]) -> bool:
    return not named or {_start(bits) + number for number in named} <= set(bits)


def _field(name: str, element_bits: int) -> tuple[int, int]:
    mantissa = MANTISSA_BITS[element_bits]
    return {
        "any": (0, element_bits),
        "mantissa": (0, mantissa),
        "exponent": (mantissa, element_bits - 1),
        "sign": (element_bits - 1, element_bits),
    }[name]


def draw_bits(fault: FaultSpec, among: Sequence[Sequence[int]], draw: np.random.Generator) -> tuple[int, ...]:
    """The bits to strike, distinct and in order: a set is drawn uniformly, then of it as the mask says."""
    chosen = among[int(draw.integers(len(among)))]
    if fault.histogram is not None:
        return _from_histogram(fault.histogram, chosen, draw)
    if fault.mask != "bits":
        return _any_of(chosen, draw)
    if fault.bit_numbers is not None:
        return tuple(sorted(chosen))
    picked = draw.choice(len(chosen), size=fault.bits, replace=False)
    return tuple(sorted(chosen[int(at)] for at in picked))


def _any_of(bits: Sequence[int], draw: np.random.Generator) -> tuple[int, ...]:
    """A part of ``bits``, each part alike but the empty one."""
    while not (flipped := draw.integers(2, size=len(bits))).any():
        continue
    return tuple(sorted(bits[int(at)] for at in np.flatnonzero(flipped)))


def _from_histogram(
    histogram: MaskHistogram, bits: Sequence[int], draw: np.random.Generator
) -> tuple[int, ...]:
    if histogram.masks:
        mask = int(_drawn(histogram.masks, draw), 16) << _start(bits)
        return tuple(bit for bit in range(mask.bit_length()) if mask >> bit & 1)
    count = _drawn(histogram.bits, draw) if histogram.bits else 1
    if not histogram.positions:
        return tuple(sorted(bits[int(at)] for at in draw.choice(len(bits), size=count, replace=False)))
    left, found = dict(histogram.positions), []
    for _ in range(count):
        found.append(_drawn(left, draw))
        del left[found[-1]]
    return tuple(sorted(_start(bits) + position for position in found))


def _drawn(table: Mapping[_Key, float], draw: np.random.Generator) -> _Key:
    """One of the table's keys, drawn in proportion to its numbers."""
    keys = [key for key, part in table.items() if part > 0]
    edges = np.cumsum([table[key] for key in keys])
    return keys[min(int(np.searchsorted(edges, draw.random() * edges[-1], side="right")), len(keys) - 1)]


def struck(fault: FaultSpec, value: int, bits: Sequence[int]) -> int:
    """What the fault makes of a value."""
    mask = sum(1 << bit for bit in bits)
    if fault.model == "none":
        return value
    if fault.model == "stuck_at":
        return value | mask if fault.stuck_value else value & ~mask
    return value ^ mask
