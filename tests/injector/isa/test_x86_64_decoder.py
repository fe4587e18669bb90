"""Decoding names every register that an instruction accesses, in which role, and how wide."""

from contextlib import suppress

import pytest

from injector.isa.instruction import Candidate, DecodeError, MemoryAccess, Role
from injector.isa.x86_64_decoder import decode
from injector.isa.x86_64_registers import GENERAL, MASK, VECTOR
from services.runtime.rng import generator

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

SOURCE: Role = "source"
DESTINATION: Role = "destination"

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
    "62f1ed49 58cb": {  # vaddpd zmm1{k1},zmm2,zmm3
        ("k1", SOURCE, 8),
        *{("zmm1", SOURCE, 512), ("zmm1", DESTINATION, 512), ("zmm2", SOURCE, 512), ("zmm3", SOURCE, 512)},
    },
    "c5f877": set(),  # vzeroupper
    "39 05 00 00 00 00": {("eax", SOURCE, 32)},  # cmp [rip],eax: not rip
    "d8c1": set(),  # fadd st,st(1)
    "f30f1efa": set(),  # endbr64
}


@pytest.mark.parametrize(("length", "code"), LENGTHS.items())
def test_every_length_decodes_whatever_follows(length: int, code: str) -> None:
    assert decode(bytes.fromhex(code) + b"\x0f" * (15 - length), 0x1000).code == bytes.fromhex(code)


CF, PF, AF, ZF, SF, DF, OF = 0, 2, 4, 6, 7, 10, 11
FLAGS = {
    "01d8": (set(), {CF, PF, AF, ZF, SF, OF}),  # add eax,ebx
    "11d8": ({CF}, {CF, PF, AF, ZF, SF, OF}),  # adc eax,ebx
    "48ffc0": (set(), {PF, AF, ZF, SF, OF}),  # inc rax keeps CF
    "21d8": (set(), {CF, PF, ZF, SF, OF}),  # and eax,ebx leaves AF undefined
    "7400": ({ZF}, set()),  # je
    "7f00": ({ZF, SF, OF}, set()),  # jg
    "0f97c0": ({CF, ZF}, set()),  # seta al
    "fc": (set(), {DF}),  # cld
    "a4": ({DF}, set()),  # movsb
    "9f": ({CF, PF, AF, ZF, SF}, set()),  # lahf
    "660f2ec1": (set(), {CF, PF, AF, ZF, SF, OF}),  # ucomisd
    "89d8": (set(), set()),  # mov eax,ebx
}

MASKS = {
    "c5fc41ca": {("k1", DESTINATION, 16), ("k0", SOURCE, 16), ("k2", SOURCE, 16)},  # kandw k1,k0,k2
    "c4e1fb92c8": {("k1", DESTINATION, 64)},  # kmovq k1,rax
    "c5f998c9": {("k1", SOURCE, 8)},  # kortestb k1,k1: read twice, one register
    "62f1f548c2c201": {("k0", DESTINATION, 8)},  # vcmpltpd k0,zmm1,zmm2
    "62f17449c2c201": {("k0", DESTINATION, 16), ("k1", SOURCE, 16)},  # vcmpltps k0{k1},zmm1,zmm2
    "62f27e2828c1": {("k1", SOURCE, 32)},  # vpmovm2b ymm0,k1
}

ELEMENTS = {
    "f20f58c1": {("xmm0", 64), ("xmm1", 64)},  # addsd
    "f30f58c1": {("xmm0", 32), ("xmm1", 32)},  # addss
    "660f58c1": {("xmm0", 64), ("xmm1", 64)},  # addpd
    "c5f458c2": {("ymm0", 32), ("ymm1", 32), ("ymm2", 32)},  # vaddps
    "c4e2f198c2": {("xmm0", 64), ("xmm1", 64), ("xmm2", 64)},  # vfmadd132pd
    "f30f5ac1": {("xmm0", 64), ("xmm0", 32), ("xmm1", 32)},  # cvtss2sd
    "0f5ac1": {("xmm0", 64), ("xmm1", 32)},  # cvtps2pd
    "0f5bc1": {("xmm0", 32), ("xmm1", 0)},  # cvtdq2ps: from integers
    "0f28c1": {("xmm0", 0), ("xmm1", 0)},  # movaps moves anything
    "c5fc1000": {("ymm0", 0)},  # vmovups
    "f20f10c1": {("xmm0", 64), ("xmm1", 64)},  # movsd
    "660ffec1": {("xmm0", 0), ("xmm1", 0)},  # paddd
    "660f5700": {("xmm0", 64)},  # xorpd: the sign of a number is changed so
}

MEMORY = {
    "8b07": [MemoryAccess(SOURCE, 32, base="rdi")],  # mov eax,[rdi]
    "884c8704": [MemoryAccess(DESTINATION, 8, base="rdi", index="rax", scale=4, displacement=4)],
    "48010a": [MemoryAccess(role, 64, base="rdx") for role in (SOURCE, DESTINATION)],  # add [rdx],rcx
    "488b0510000000": [MemoryAccess(SOURCE, 64, displacement=0x1017)],  # mov rax,[rip+10h]
    "64488b042528000000": [MemoryAccess(SOURCE, 64, displacement=0x28, segment="fs_base")],
    "678b07": [MemoryAccess(SOURCE, 32, base="edi", address_bits=32)],  # mov eax,[edi]
    "50": [MemoryAccess(DESTINATION, 64, base="rsp", displacement=2**64 - 8)],  # push rax
    "c3": [MemoryAccess(SOURCE, 64, base="rsp")],  # ret
    "f20f5807": [MemoryAccess(SOURCE, 64, 64, base="rdi")],  # addsd xmm0,[rdi]
    "c5fc5807": [MemoryAccess(SOURCE, 256, 32, base="rdi")],  # vaddps ymm0,ymm0,[rdi]
    "62f1fd585807": [MemoryAccess(SOURCE, 64, 64, base="rdi")],  # vaddpd zmm0,zmm0,[rdi]{1to8}
    "a4": [MemoryAccess(DESTINATION, 8, base="rdi"), MemoryAccess(SOURCE, 8, base="rsi")],  # movsb
    "a5": [
        MemoryAccess(DESTINATION, 32, base="rdi"),
        MemoryAccess(SOURCE, 32, base="rsi"),
    ],  # movsd
    "dd07": [MemoryAccess(SOURCE, 64, 64, base="rdi")],  # fld qword ptr [rdi]
    "0f1007": [MemoryAccess(SOURCE, 128, base="rdi")],  # movups moves anything
    "f3a4": [],  # rep movsb may do nothing
    "488d07": [],  # lea
    "0f1f00": [],  # nop [rax]
    "0fae07": [],  # fxsave [rdi]
    "c4e2f192047a": [],  # vgatherdpd: many words
    "4801c8": [],  # add rax,rcx
}


def kinds(code: str, *classes: str) -> list[Candidate]:
    return [one for one in decode(bytes.fromhex(code), 0x1000).candidates if one.register_class in classes]


@pytest.mark.parametrize(("code", "expected"), ACCESSES.items())
def test_registers_roles_and_widths(code: str, expected: set[tuple[str, str, int]]) -> None:
    candidates = kinds(code, "gpr", "vector", "mask")
    assert {(one.register, one.role, one.width_bits) for one in candidates} == expected
    assert len(candidates) == len(expected)


@pytest.mark.parametrize(("code", "expected"), FLAGS.items())
def test_status_flags_that_are_read_and_written(code: str, expected: tuple[set[int], set[int]]) -> None:
    found = {one.role: set(one.accessed) for one in kinds(code, "flags")}
    assert (found.get(SOURCE, set()), found.get(DESTINATION, set())) == expected


@pytest.mark.parametrize(("code", "expected"), MASKS.items())
def test_a_mask_counts_with_its_lanes(code: str, expected: set[tuple[str, str, int]]) -> None:
    assert {(one.register, one.role, one.width_bits) for one in kinds(code, "mask")} == expected


@pytest.mark.parametrize(("code", "expected"), ELEMENTS.items())
def test_what_a_vector_is_taken_for(code: str, expected: set[tuple[str, int]]) -> None:
    assert {(one.register, one.element_bits) for one in kinds(code, "vector")} == expected


@pytest.mark.parametrize(("code", "expected"), MEMORY.items())
def test_memory_that_is_accessed(code: str, expected: list[MemoryAccess]) -> None:
    assert list(decode(bytes.fromhex(code), 0x1000).memory) == expected


def test_whatever_is_decoded_has_a_name_that_can_be_read() -> None:
    known = {*GENERAL, *VECTOR, *MASK, "rflags", "fs_base", "gs_base", ""}
    prefixes = [b"", b"\x62", b"\xc5", b"\xc4", b"\x0f", b"\x66", b"\xf2"]  # EVEX, VEX and the like
    draw, decoded = generator(1, "code"), 0
    while decoded < 5000:
        code = prefixes[int(draw.integers(len(prefixes)))] + draw.bytes(15)
        with suppress(DecodeError):
            found = decode(code[:15], 0x1000)
            decoded += 1
            widths = [(one.width_bits, one.element_bits) for one in found.candidates]
            widths += [(one.width_bits, one.element_bits) for one in found.memory]
            assert all(width > 0 and width % (element or 1) == 0 for width, element in widths)
            assert {one.register for one in found.candidates} <= known
            assert all({one.base, one.index, one.segment} <= known for one in found.memory)


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
