"""What a translation is made of; that it does what the block does is tested where calls are counted."""

import pytest

from injector.block_profile.x86_64_translator import Counters, TranslationError, jump, translate

pytestmark = pytest.mark.unit

AT, THERE = 0x7F00_0000_0000, 0x7F00_1000_0000
COUNTERS = Counters(passes=THERE + 0x10_0000, scratch=THERE + 0x20_0000)
INCREMENT = bytes.fromhex("48ff05")


def hexed(code: str) -> bytes:
    return bytes.fromhex(code.replace(" ", ""))


def test_a_block_ends_with_the_first_instruction_that_may_lead_elsewhere() -> None:
    made = translate(hexed("48ffc0 4801c8 75f8 90 90"), AT, THERE, COUNTERS)  # inc rax; add; jne -8
    assert made.instructions == (AT, AT + 3, AT + 6)
    assert made.size == 8
    assert [one.target for one in made.exits] == [AT, AT + 8]
    for one in made.exits:
        assert made.code[one.trap - THERE] == 0xCC
        field = one.field - THERE
        assert made.code[field : field + 4] == one.leading_to(one.trap)


def test_a_block_ends_before_another_one_begins() -> None:
    made = translate(hexed("48ffc0 4801c8 75f8"), AT, THERE, COUNTERS, leaders={AT + 3})
    assert made.instructions == (AT,)
    assert [one.target for one in made.exits] == [AT + 3]


@pytest.mark.parametrize(
    ("code", "free"),
    [
        ("4801c8 c3", True),  # add rax,rcx sets all flags
        ("7500", False),  # jne reads one at once
        ("0f94c0 4801c8 c3", False),  # sete reads one before add sets them
        ("4889c8 c3", False),  # mov sets none, and who is returned to may read them
        ("48d3e0 c3", False),  # shl rax,cl sets none if cl is 0
        ("f3a6 c3", False),  # repe cmpsb sets none if rcx is 0
        ("4811c8 c3", True),  # adc reads the carry, which counting keeps
    ],
)
def test_flags_are_changed_only_where_the_block_sets_them_first(code: str, free: bool) -> None:
    made = translate(hexed(code), AT, THERE, COUNTERS)
    assert made.code.startswith(INCREMENT) == free


def test_what_an_operand_beside_the_program_counter_refers_to_stays() -> None:
    made = translate(hexed("488b0500010000 c3"), AT, THERE, COUNTERS)  # mov rax,[rip+100h]
    at = made.code.index(hexed("488b05"), len(made.code) - 8 - 3)
    assert THERE + at + 7 + int.from_bytes(made.code[at + 3 : at + 7], "little", signed=True) == AT + 0x107


@pytest.mark.parametrize(
    ("code", "address", "takes"),
    [
        ("55 4889e5 53 c3", AT, True),  # a function's beginning
        ("55 4889e5 53 c3", AT + 8, False),
        ("f30f1efa 53 c3", AT + 8, True),  # endbr64
        ("b801000000 c3", AT + 8, True),  # one instruction of five bytes
        ("53 c3", AT, False),  # too short
    ],
)
def test_a_jump_is_written_only_where_nobody_arrives_within_it(code: str, address: int, takes: bool) -> None:
    assert translate(hexed(code), address, THERE, COUNTERS).takes_a_jump == takes


def test_a_jump_leads_where_it_should() -> None:
    assert jump(AT, AT + 5) == hexed("e900000000")
    assert jump(AT, AT) == hexed("e9fbffffff")


def test_what_cannot_be_translated_is_told() -> None:
    with pytest.raises(TranslationError, match="no instruction at"):
        translate(b"\x06", AT, THERE, COUNTERS)
    with pytest.raises(TranslationError, match="too far"):
        translate(hexed("e800000000"), AT, AT + (1 << 33), COUNTERS)
