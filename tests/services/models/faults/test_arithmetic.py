"""Which bits a fault draws, and what it makes of a value."""

import struct
from typing import Any

import pytest
from scipy.stats import chisquare

from services.models.faults.arithmetic import draw_bits, groups, struck
from services.models.faults.specification import FaultSpec
from services.runtime.rng import generator


def fault(**fields: Any) -> FaultSpec:
    return FaultSpec(target="pid", **fields)


def drawn(spec: FaultSpec, width: int, element: int = 0, count: int = 200) -> list[tuple[int, ...]]:
    draw = generator(1, "bits")
    return [draw_bits(spec, groups(spec, width, element), draw) for _ in range(count)]


@pytest.mark.parametrize("count", [1, 2, 3, 8, 64])
def test_drawn_bits_are_distinct_so_they_never_cancel(count: int) -> None:
    for bits in drawn(fault(bits=count), 64):
        assert len(set(bits)) == count
        assert bits == tuple(sorted(bits))
        assert struck(fault(bits=count), 0, bits).bit_count() == count


def test_every_bit_is_as_likely_as_any_other() -> None:
    counts = [0] * 64
    for bits in drawn(fault(bits=2), 64, count=6400):
        for bit in bits:
            counts[bit] += 1
    assert chisquare(counts).pvalue > 0.01


@pytest.mark.parametrize("element", [32, 64])
@pytest.mark.parametrize("name", ["sign", "exponent", "mantissa"])
def test_a_field_is_that_of_one_number_of_the_vector(name: str, element: int) -> None:
    form, mantissa = {32: ("<f", 23), 64: ("<d", 52)}[element]
    field = {
        "sign": range(element - 1, element),
        "exponent": range(mantissa, element - 1),
        "mantissa": range(mantissa),
    }[name]
    lanes = set()
    seen = set()
    for (bit,) in drawn(fault(field=name), 256, element, count=3000):
        lanes.add(bit // element)
        seen.add(bit % element)
        if name == "sign":
            (value,) = struct.unpack(
                form, (0x3F << element - 8 ^ 1 << bit % element).to_bytes(element // 8, "little")
            )
            assert value < 0
    assert lanes == set(range(256 // element))
    assert seen == set(field)


def test_several_bits_of_a_field_are_of_the_same_number() -> None:
    for bits in drawn(fault(field="exponent", bits=3), 256, 64):
        assert len({bit // 64 for bit in bits}) == 1


def test_what_an_operand_does_not_have_is_not_eligible() -> None:
    assert groups(fault(field="exponent"), 128, 0) == []  # no floating-point number
    assert groups(fault(field="exponent", bits=9), 32, 32) == []  # binary32 has eight
    assert groups(fault(bits=9), 8) == []
    assert groups(fault(bit_numbers=(3, 40)), 32) == []
    assert groups(fault(bits=2), 64, 0, (0, 2, 11)) == [(0, 2, 11)]  # status flags
    assert groups(fault(bit_numbers=(1,)), 64, 0, (0, 2, 11)) == []


def test_named_bits_are_struck_and_all_of_them() -> None:
    assert set(drawn(fault(bit_numbers=(40, 3)), 64)) == {(3, 40)}


def test_what_becomes_of_a_value() -> None:
    assert struck(fault(), 0b1100, (2, 0)) == 0b1001
    assert struck(fault(model="none"), 0b1100, (2, 0)) == 0b1100
    assert struck(fault(model="stuck_at", stuck_value=1, stuck_instructions=1), 0b1100, (2, 0)) == 0b1101
    assert struck(fault(model="stuck_at", stuck_value=0, stuck_instructions=1), 0b1100, (2, 0)) == 0b1000
