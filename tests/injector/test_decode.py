"""Decoding names every register that an instruction accesses, in which role, and how wide."""

import pytest

from injector.decode import DecodeError, decode

LENGTHS = {
    1: "90",
    2: "89d8",
    3: "4889d8",
    4: "488b4608",
    5: "b801000000",
    6: "81c300010000",
    7: "4881c300010000",
    8: "488b8424 00010000",
    9: "660f1f840000000000",
    10: "48b80102030405060708",
    11: "66660f1f840000000000",
    12: "4881842400010000 00020000",
    13: "6448818424 0001000000020000",
    14: "666448818424 0001000000020000",
    15: "66666448818424 0001000000020000",
}

SOURCE, DESTINATION = "source", "destination"

ACCESSES = {
    "b801000000": {("eax", DESTINATION, 32)},  # mov eax,1: not rax, though its upper half is cleared
    "01d8": {("eax", SOURCE, 32), ("eax", DESTINATION, 32), ("ebx", SOURCE, 32)},  # add eax,ebx
    "48f7f1": {  # div rcx
        *{("rcx", SOURCE, 64), ("rax", SOURCE, 64), ("rax", DESTINATION, 64)},
        *{("rdx", SOURCE, 64), ("rdx", DESTINATION, 64)},
    },
    "f7e1": {  # mul ecx
        *{("ecx", SOURCE, 32), ("eax", SOURCE, 32), ("eax", DESTINATION, 32), ("edx", DESTINATION, 32)},
    },
    "99": {("eax", SOURCE, 32), ("edx", DESTINATION, 32)},  # cdq
    "88dc": {("bl", SOURCE, 8), ("ah", DESTINATION, 8)},  # mov ah,bl
    "4188d8": {("bl", SOURCE, 8), ("r8b", DESTINATION, 8)},  # mov r8b,bl
    "8a04cf": {("al", DESTINATION, 8), ("rdi", SOURCE, 64), ("rcx", SOURCE, 64)},  # mov al,[rdi+rcx*8]
    "50": {("rax", SOURCE, 64), ("rsp", SOURCE, 64), ("rsp", DESTINATION, 64)},  # push rax
    "f3a4": {  # rep movsb
        *{(name, role, 64) for name in ("rcx", "rsi", "rdi") for role in (SOURCE, DESTINATION)},
    },
    "31c0": {("eax", DESTINATION, 32)},  # xor eax,eax reads nothing
    "f20f58c1": {("xmm0", SOURCE, 64), ("xmm0", DESTINATION, 64), ("xmm1", SOURCE, 64)},  # addsd
    "f30f5ac1": {("xmm0", SOURCE, 32), ("xmm0", DESTINATION, 64), ("xmm1", SOURCE, 32)},  # cvtss2sd
    "f2480f2cc1": {("rax", DESTINATION, 64), ("xmm1", SOURCE, 64)},  # cvttsd2si
    "660f58c1": {("xmm0", SOURCE, 128), ("xmm0", DESTINATION, 128), ("xmm1", SOURCE, 128)},  # addpd
    "c5f358c2": {("xmm0", DESTINATION, 64), ("xmm1", SOURCE, 64), ("xmm2", SOURCE, 64)},  # vaddsd
    "c5f558c2": {("ymm0", DESTINATION, 256), ("ymm1", SOURCE, 256), ("ymm2", SOURCE, 256)},  # vaddpd
    "c4e27d19c1": {("ymm0", DESTINATION, 256), ("xmm1", SOURCE, 128)},  # vbroadcastsd
    "660f38 1ec1": {("xmm0", DESTINATION, 128), ("xmm1", SOURCE, 128)},  # pabsd: no scalar, for all its name
    "62f1ed48 58cb": {("zmm1", DESTINATION, 512), ("zmm2", SOURCE, 512), ("zmm3", SOURCE, 512)},  # vaddpd
    "62f1ed49 58cb": {  # vaddpd zmm1{k1},zmm2,zmm3: the mask is not offered
        *{("zmm1", SOURCE, 512), ("zmm1", DESTINATION, 512), ("zmm2", SOURCE, 512), ("zmm3", SOURCE, 512)},
    },
    "c5f877": set(),  # vzeroupper
    "39 05 00 00 00 00": {("eax", SOURCE, 32)},  # cmp [rip],eax: neither rip nor flags
    "d8c1": set(),  # fadd st,st(1)
    "f30f1efa": set(),  # endbr64
}


@pytest.mark.parametrize(("length", "code"), LENGTHS.items())
def test_every_length_decodes_whatever_follows(length: int, code: str) -> None:
    assert decode(bytes.fromhex(code) + b"\x0f" * (15 - length), 0x1000).code == bytes.fromhex(code)


@pytest.mark.parametrize(("code", "expected"), ACCESSES.items())
def test_registers_roles_and_widths(code: str, expected: set[tuple[str, str, int]]) -> None:
    candidates = decode(bytes.fromhex(code), 0x1000).candidates
    assert {(one.register, one.role, one.width_bits) for one in candidates} == expected
    assert len(candidates) == len(expected)


def test_text_is_intel_syntax() -> None:
    assert decode(bytes.fromhex("01d8"), 0).text == "add eax,ebx"


def test_candidates_are_chosen_by_role_and_class() -> None:
    load = decode(bytes.fromhex("f20f1000"), 0)  # movsd xmm0,[rax]
    assert [one.register for one in load.eligible("any", "any")] == ["xmm0", "rax"]
    assert [one.register for one in load.eligible("source", "any")] == ["rax"]
    assert [one.register for one in load.eligible("destination", "vector")] == ["xmm0"]
    assert load.eligible("destination", "gpr") == []


@pytest.mark.parametrize("code", ["0f05", "0f34", "cd80", "9c"])
def test_system_calls_and_stored_flags_are_not_stepped(code: str) -> None:
    assert not decode(bytes.fromhex(code), 0).steppable


@pytest.mark.parametrize("code", ["", "48", "b801", "06"])
def test_what_is_no_instruction_is_refused(code: str) -> None:
    with pytest.raises(DecodeError):
        decode(bytes.fromhex(code), 0)
