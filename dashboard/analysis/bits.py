"""The corrupted bits of an injection, to be drawn: the word that has them, bit by bit, before and after."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from itertools import groupby
from typing import Literal

from services.models.faults.arithmetic import MANTISSA_BITS
from services.models.outcome import InjectionRecord

Field = Literal["sign", "exponent", "mantissa", "integer"]

_FLOATS = {32: (4, "<f"), 64: (8, "<d")}
_WORD_BITS = 64
"""What an operand without numbers of a known width is cut into."""


@dataclass(frozen=True, slots=True)
class Bit:
    """One bit; ``number`` is that of the record, counted over the whole operand."""

    number: int
    before: bool
    after: bool
    corrupted: bool


@dataclass(frozen=True, slots=True)
class BitRange:
    """Neighbouring bits of one meaning, the most significant first."""

    field: Field
    bits: tuple[Bit, ...]


@dataclass(frozen=True, slots=True)
class Word:
    """One number of an operand: bits ``low`` to ``low + width - 1``. Texts say its value."""

    low: int
    width: int
    parts: tuple[BitRange, ...]
    before: str
    after: str

    @property
    def change(self) -> str:
        """In words, for who cannot see the bits."""
        numbers = [bit.number for part in self.parts for bit in part.bits if bit.corrupted]
        return (
            f"bits {numbers[-1]} to {numbers[0]} corrupted"
            if len(numbers) > 1
            else f"bit {numbers[0]} corrupted"
        )


def words(record: InjectionRecord) -> list[Word]:
    """The words of the operand in which a bit was corrupted, the lowest first; none if nothing was."""
    if not (record.bits and record.before and record.after):
        return []
    width = record.element_bits if record.element_bits in _FLOATS else min(record.width_bits, _WORD_BITS)
    lows = sorted({number // width * width for number in record.bits})
    return [_word(record, low, min(width, record.width_bits - low)) for low in lows]


def _word(record: InjectionRecord, low: int, width: int) -> Word:
    before, after = (int(text, 16) >> low & (1 << width) - 1 for text in (record.before, record.after))
    floating = width == record.element_bits and width in _FLOATS
    bits = [
        (
            _field(at, width) if floating else "integer",
            Bit(low + at, bool(before >> at & 1), bool(after >> at & 1), low + at in record.bits),
        )
        for at in reversed(range(width))
    ]
    parts = tuple(
        BitRange(field, tuple(bit for _, bit in group))
        for field, group in groupby(bits, key=lambda one: one[0])
    )
    return Word(low, width, parts, *(_text(value, width, floating=floating) for value in (before, after)))


def _field(at: int, width: int) -> Field:
    if at == width - 1:
        return "sign"
    return "mantissa" if at < MANTISSA_BITS[width] else "exponent"


def _text(value: int, width: int, *, floating: bool) -> str:
    if not floating:
        return f"{value:#0{2 + -(-width // 4)}x} = {value}"
    size, form = _FLOATS[width]
    return f"{struct.unpack(form, value.to_bytes(size, 'little'))[0]:.9g}"
