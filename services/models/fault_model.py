"""The fault models as arithmetic: which bits may be drawn, and what becomes of a value."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from services.models.fault_spec import FaultSpec

MANTISSA_BITS = {32: 23, 64: 52}  # IEEE 754 binary32 and binary64


def groups(
    fault: FaultSpec, width_bits: int, element_bits: int = 0, accessed: Sequence[int] = ()
) -> list[Sequence[int]]:
    """The sets of bits of which the fault draws one, and then its bits within; empty if none has enough.

    One set for ``field`` any: all bits that are accessed. Else one for each number in the operand: the
    field's bits of that number. ``bit_numbers`` are a set of their own, if the operand has all of them.
    """
    every: Sequence[int] = accessed or range(width_bits)
    if fault.bit_numbers is not None:
        return [fault.bit_numbers] if set(fault.bit_numbers) <= set(every) else []
    if fault.field == "any":
        found = [every]
    elif not element_bits:
        found = []
    else:
        found = [
            range(lane + bounds[0], lane + bounds[1])
            for bounds in [_field(fault.field, element_bits)]
            for lane in range(0, width_bits, element_bits)
        ]
    return [bits for bits in found if len(bits) >= fault.bits]


def _field(name: str, element_bits: int) -> tuple[int, int]:
    mantissa = MANTISSA_BITS[element_bits]
    return {
        "mantissa": (0, mantissa),
        "exponent": (mantissa, element_bits - 1),
        "sign": (element_bits - 1, element_bits),
    }[name]


def draw_bits(fault: FaultSpec, among: Sequence[Sequence[int]], draw: np.random.Generator) -> tuple[int, ...]:
    """The bits to strike, distinct and in order: a set is drawn uniformly, then bits of it uniformly."""
    chosen = among[int(draw.integers(len(among)))]
    if fault.bit_numbers is not None:
        return tuple(sorted(chosen))
    picked = draw.choice(len(chosen), size=fault.bits, replace=False)
    return tuple(sorted(chosen[int(at)] for at in picked))


def struck(fault: FaultSpec, value: int, bits: Sequence[int]) -> int:
    """What the fault makes of a value."""
    mask = sum(1 << bit for bit in bits)
    if fault.model == "none":
        return value
    if fault.model == "stuck_at":
        return value | mask if fault.stuck_value else value & ~mask
    return value ^ mask
