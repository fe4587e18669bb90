"""Masks follow their declared law, and one that makes no sense is refused."""

from collections import Counter, defaultdict
from collections.abc import Callable, Hashable, Mapping
from itertools import permutations
from typing import Any

import pytest
from pydantic import ValidationError
from scipy.stats import chisquare

from deploy.errors import one_line
from services.models.faults.arithmetic import draw_bits, groups
from services.models.faults.specification import FaultSpec
from services.runtime.rng import generator

N = 10_000
FLAGS = (0, 2, 4, 6, 7, 10, 11)


def fault(mask: str, **fields: Any) -> FaultSpec:
    return FaultSpec.model_validate({"target": "pid", "mask": mask, **fields})


def histogram(**tables: Mapping[Any, float]) -> FaultSpec:
    return fault("histogram", histogram=tables)


def drawn(
    spec: FaultSpec, width: int, element: int = 0, accessed: tuple[int, ...] = ()
) -> list[tuple[int, ...]]:
    draw = generator(5, "masks")
    return [draw_bits(spec, groups(spec, width, element, accessed), draw) for _ in range(N)]


def follows(
    masks: list[tuple[int, ...]],
    law: Mapping[Any, float],
    seen_as: Callable[[tuple[int, ...]], Hashable] = lambda bits: bits,
) -> None:
    """Chi-square of what was drawn against the law; nothing but what has a probability may be drawn."""
    counts = Counter(seen_as(bits) for bits in masks)
    assert set(counts) <= set(law)
    assert sum(law.values()) == pytest.approx(1.0)
    total = sum(law.values())
    assert (
        chisquare([counts[one] for one in law], [part / total * len(masks) for part in law.values()]).pvalue
        > 0.01
    )


def alike(keys: Any) -> dict[Any, float]:
    every = list(keys)
    return {key: 1 / len(every) for key in every}


def as_number(bits: tuple[int, ...]) -> int:
    return sum(1 << bit for bit in bits)


def pairs(count: int) -> dict[tuple[int, ...], float]:
    return alike((low, high) for high in range(count) for low in range(high))


def test_bits_are_pairs_alike() -> None:
    follows(drawn(fault("bits", bits=2), 16), pairs(16))


def test_uniform_is_every_mask_but_none_alike() -> None:
    follows(drawn(fault("uniform"), 8), alike(range(1, 256)), as_number)


def test_uniform_flips_half_of_a_wide_operand() -> None:
    masks = drawn(fault("uniform"), 64)
    counts = Counter(bit for bits in masks for bit in bits)
    assert (
        chisquare([one for bit in range(64) for one in (counts[bit], N - counts[bit])], ddof=63).pvalue > 0.01
    )
    follows(masks, alike(range(16)), lambda bits: as_number(bits) >> 30 & 15)


def test_uniform_of_a_field_and_of_flags_stays_within() -> None:
    exponents = drawn(fault("uniform", field="exponent"), 128, 64)
    follows(exponents, alike((0, 1)), lambda bits: bits[0] // 64)
    assert {bit % 64 for bits in exponents for bit in bits} == set(range(52, 63))
    assert all(len({bit // 64 for bit in bits}) == 1 for bits in exponents)
    law = alike(sum(1 << FLAGS[at] for at in range(7) if one >> at & 1) for one in range(1, 128))
    follows(drawn(fault("uniform"), 64, 0, FLAGS), law, as_number)


def test_a_byte_is_aligned_and_every_pattern_of_it_alike() -> None:
    masks = drawn(fault("byte"), 64)
    assert all(bits[0] // 8 == bits[-1] // 8 for bits in masks)
    follows(masks, alike(range(8)), lambda bits: bits[0] // 8)
    follows(masks, alike(range(1, 256)), lambda bits: as_number(bits) >> bits[0] // 8 * 8)


def test_a_word_is_aligned_and_every_pattern_of_it_alike() -> None:
    masks = drawn(fault("word"), 128)
    assert all(bits[0] // 32 == bits[-1] // 32 for bits in masks)
    follows(masks, alike(range(4)), lambda bits: bits[0] // 32)
    for nibble in range(8):
        follows(
            masks,
            alike(range(16)),
            lambda bits, at=4 * nibble: as_number(bits) >> bits[0] // 32 * 32 + at & 15,  # type: ignore[misc]
        )


@pytest.mark.parametrize(("mask", "width"), [("byte", 4), ("word", 4)])
def test_what_is_narrower_is_struck_whole(mask: str, width: int) -> None:
    follows(drawn(fault(mask), width), alike(range(1, 1 << width)), as_number)


def test_of_flags_the_accessed_ones_of_a_byte_are_struck() -> None:
    law = {sum(1 << FLAGS[at] for at in range(5) if one >> at & 1): 1 / 62 for one in range(1, 32)}
    law |= {1 << 10: 1 / 6, 1 << 11: 1 / 6, 3 << 10: 1 / 6}
    follows(drawn(fault("byte"), 64, 0, FLAGS), law, as_number)


COUNTS = {1: 0.7, 2: 0.2, 4: 0.1}


def test_a_histogram_says_how_many_bits() -> None:
    masks = drawn(histogram(bits=COUNTS), 64)
    follows(masks, COUNTS, len)
    follows([bits for bits in masks if len(bits) == 1], alike(range(64)), lambda bits: bits[0])
    exponents = drawn(fault("histogram", histogram={"bits": COUNTS}, field="exponent"), 32, 32)
    follows(exponents, COUNTS, len)
    assert {bit for bits in exponents for bit in bits} == set(range(23, 31))


def test_a_histogram_says_which_bits_and_each_further_one_is_of_those_left() -> None:
    places = {3: 0.5, 11: 0.3, 20: 0.2, 21: 0.0}
    law: dict[tuple[int, ...], float] = defaultdict(float)
    for first, second in permutations((3, 11, 20), 2):
        law[tuple(sorted((first, second)))] += 0.6 * places[first] * places[second] / (1 - places[first])
    law |= {(place,): 0.4 * part for place, part in places.items() if part}
    follows(drawn(histogram(bits={1: 0.4, 2: 0.6}, positions=places), 32), law)


def test_a_histogram_of_masks_is_of_one_number_of_the_operand() -> None:
    masks = drawn(histogram(masks={"0x1": 0.5, "0x8001": 0.3, "0x80000000": 0.2}), 64, 32)
    assert {bits[0] // 32 for bits in masks} == {0, 1}
    law = {(0,): 0.5, (0, 15): 0.3, (31,): 0.2}
    follows(masks, law, lambda bits: tuple(bit % 32 for bit in bits))
    whole = drawn(histogram(masks={"0x1": 0.5, "0x8001": 0.5}), 64)  # an operand without numbers
    follows(whole, {(0,): 0.5, (0, 15): 0.5})


def test_an_operand_is_eligible_if_all_that_may_be_drawn_fits() -> None:
    assert groups(histogram(bits={1: 0.5, 16: 0.5}), 8) == []
    assert groups(histogram(bits={1: 1.0, 16: 0.0}), 8) != []
    assert groups(histogram(positions={7: 0.5, 40: 0.5}), 32) == []
    assert groups(histogram(positions={7: 0.5, 40: 0.5}), 128, 32) == []  # no binary32 has a bit 40
    assert groups(histogram(masks={"0x100": 1.0}), 8) == []
    assert groups(histogram(positions={2: 1.0}), 64, 0, FLAGS) == [FLAGS]
    assert groups(histogram(positions={1: 1.0}), 64, 0, FLAGS) == []


def test_the_order_of_a_histogram_changes_no_draw() -> None:
    there, back = {1: 0.5, 2: 0.3, 3: 0.2}, {3: 0.2, 2: 0.3, 1: 0.5}
    assert histogram(bits=there).model_dump_json() == histogram(bits=back).model_dump_json()
    assert drawn(histogram(bits=there), 16) == drawn(histogram(bits=back), 16)


def test_draws_of_n_bits_are_those_of_before_masks() -> None:
    draw = generator(1, "bits")
    spec = FaultSpec(target="pid", bits=3)
    assert [draw_bits(spec, groups(spec, 64), draw) for _ in range(3)] == [
        (9, 25, 42),
        (16, 23, 58),
        (6, 28, 59),
    ]


STUCK = {"model": "stuck_at", "stuck_value": 0, "stuck_instructions": 3}


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"mask": "nibble"}, "mask"),
        ({"mask": "byte", "bits": 2}, "mask byte itself says how many"),
        ({"mask": "uniform", "bit_numbers": [3]}, "bit_numbers and mask uniform"),
        ({"mask": "word", "field": "mantissa"}, "field and mask word"),
        ({"mask": "word", "model": "opcode"}, "bytes, no words"),
        ({"mask": "byte", "level": "sensor", "target": "imu", "model": "off"}, "mask: not of a sensor"),
        ({"mask": "histogram"}, "needs histogram"),
        ({"histogram": {"bits": {1: 1.0}}}, "histogram goes with mask histogram"),
        (
            {"mask": "histogram", "histogram": "/etc/hostname"},
            "histogram: Input should be a valid dictionary",
        ),
        ({"mask": "histogram", "histogram": {}}, "table bits, positions or masks"),
        ({"mask": "histogram", "histogram": {"bits": {1: 0.5, 2: 0.4}}}, "bits sums to 0.9, not to 1"),
        ({"mask": "histogram", "histogram": {"positions": {1: 0.7, 2: 0.4}}}, "positions sums to 1.1"),
        ({"mask": "histogram", "histogram": {"bits": {1: 1.1, 2: -0.1}}}, "histogram.bits"),
        ({"mask": "histogram", "histogram": {"bits": {1: float("nan")}}}, "finite"),
        ({"mask": "histogram", "histogram": {"bits": {0: 1.0}}}, "greater than or equal to 1"),
        ({"mask": "histogram", "histogram": {"bits": {513: 1.0}}}, "512"),
        ({"mask": "histogram", "histogram": {"positions": {512: 1.0}}}, "512"),
        ({"mask": "histogram", "histogram": {"bits": {"many": 1.0}}}, "many"),
        ({"mask": "histogram", "histogram": {"masks": {"0x0": 1.0}}}, "masks"),
        ({"mask": "histogram", "histogram": {"masks": {"3": 1.0}}}, "masks"),
        ({"mask": "histogram", "histogram": {"masks": {"0x3": 1.0}, "bits": {1: 1.0}}}, "leave out bits"),
        ({"mask": "histogram", "histogram": {"bits": {3: 1.0}, "positions": {1: 0.5, 2: 0.5}}}, "3 of 2"),
        (
            {"mask": "histogram", "histogram": {"positions": {1: 1.0}}, "field": "sign"},
            "field and mask histogram",
        ),
        ({"mask": "histogram", "histogram": {"bits": {12: 1.0}}, "field": "exponent"}, "at most 11, got 12"),
    ],
)
def test_a_mask_that_makes_no_sense_is_refused_in_one_line(fields: dict[str, Any], says: str) -> None:
    with pytest.raises(ValidationError) as refusal:
        FaultSpec.model_validate({"target": "pid", **fields})
    line = one_line(refusal.value)
    assert says in line
    assert "\n" not in line


@pytest.mark.parametrize(
    "fields",
    [
        {"mask": "uniform", "field": "exponent", **STUCK},
        {"mask": "byte", "model": "opcode"},
        {"mask": "word", "level": "source", "target": "command.velocity", "components": "all"},
        {"mask": "histogram", "histogram": {"bits": {2: 0.25, 1: 0.75}, "positions": {9: 0.5, 3: 0.5}}},
        {"mask": "histogram", "histogram": {"masks": {"0x81": 0.25, "0x3": 0.75}}, "model": "memory"},
    ],
)
def test_a_mask_survives_json(fields: dict[str, Any]) -> None:
    spec = FaultSpec.model_validate({"target": "pid", **fields})
    assert FaultSpec.model_validate_json(spec.model_dump_json()) == spec
    assert FaultSpec.model_validate(spec.model_dump()) == spec
