"""Bits of an injection as they are drawn."""

import struct

import pytest

from dashboard.analysis.bits import words
from services.models.outcome import InjectionRecord


def record(before: int, bits: list[int], width: int, element: int = 0) -> InjectionRecord:
    after = before ^ sum(1 << bit for bit in bits)
    return InjectionRecord(
        status="injected",
        node="control",
        kernel="pid",
        invocation=3,
        width_bits=width,
        element_bits=element,
        bits=bits,
        before=f"{before:x}",
        after=f"{after:x}",
    )


@pytest.mark.parametrize(("form", "width", "exponent"), [("<f", 32, 8), ("<d", 64, 11)])
def test_a_number_is_cut_into_sign_exponent_and_mantissa(form: str, width: int, exponent: int) -> None:
    value = int.from_bytes(struct.pack(form, 0.5), "little")
    (word,) = words(record(value, [width - 2], width, width))
    assert [part.field for part in word.parts] == ["sign", "exponent", "mantissa"]
    assert [len(part.bits) for part in word.parts] == [1, exponent, width - 1 - exponent]
    struck = [bit for part in word.parts for bit in part.bits if bit.corrupted]
    assert [(bit.number, bit.before, bit.after) for bit in struck] == [(width - 2, False, True)]
    assert word.before == "0.5"
    assert float(word.after) > 1e38


def test_of_a_vector_only_the_struck_lanes_are_shown() -> None:
    lanes = struct.pack("<4d", 1.0, 2.0, 3.0, 4.0)
    found = words(record(int.from_bytes(lanes, "little"), [64 + 63, 192 + 51], 256, 64))
    assert [(word.low, word.before, word.after) for word in found] == [(64, "2", "-2"), (192, "4", "6")]


def test_an_integer_has_no_fields() -> None:
    (word,) = words(record(0x10, [0, 4], 8))
    (part,) = word.parts
    assert part.field == "integer"
    assert [bit.number for bit in part.bits] == [7, 6, 5, 4, 3, 2, 1, 0]
    assert (word.before, word.after) == ("0x10 = 16", "0x01 = 1")
    assert word.change == "bits 0 to 4 corrupted"


def test_where_nothing_was_struck_nothing_is_drawn() -> None:
    missed = InjectionRecord(status="not_reached", node="control", kernel="pid", invocation=3)
    assert words(missed) == []
