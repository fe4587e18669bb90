"""AArch64 on recorded bytes and register images: what a Cortex-A would show, without one."""

import struct
from contextlib import suppress
from dataclasses import dataclass, field

import pytest

from injector.isa.aarch64_decoder import decode
from injector.isa.aarch64_registers import NT_PRFPREG, REGISTER_CLASSES, STATUS_FLAGS, AArch64Registers
from injector.isa.instruction import DecodeError, MemoryAccess, Role
from injector.isa.registers import UnknownRegisterError
from injector.tracing.ptrace import NT_PRSTATUS, PtraceError
from services.runtime.rng import generator

GENERAL = [0x0123456789ABCDEF * (number + 1) % 2**64 for number in range(32)]
PC, PSTATE = 0xFFFF_8000_1234, 0x6000_1000
VECTORS = [0x9E3779B97F4A7C15F39CC0605CEDC834 * (number + 1) % 2**128 for number in range(32)]


@dataclass
class Image:
    """What GETREGSET returns and SETREGSET is given."""

    sets: dict[int, bytearray] = field(
        default_factory=lambda: {
            NT_PRSTATUS: bytearray(struct.pack("<34Q", *GENERAL, PC, PSTATE)),
            NT_PRFPREG: bytearray(
                b"".join(value.to_bytes(16, "little") for value in VECTORS) + struct.pack("<IIII", 1, 2, 0, 0)
            ),
        }
    )
    written: list[int] = field(default_factory=list)

    def registers(self) -> AArch64Registers:
        return AArch64Registers(1, lambda _, kind, __: bytearray(self.sets[kind]), self.write)

    def write(self, _: int, kind: int, content: bytearray) -> None:
        self.written.append(kind)
        self.sets[kind] = bytearray(content)


def expected(general: dict[int, int] | None = None, vectors: dict[int, int] | None = None) -> Image:
    image = Image()
    for number, value in (general or {}).items():
        struct.pack_into("<Q", image.sets[NT_PRSTATUS], 8 * number, value)
    for number, value in (vectors or {}).items():
        image.sets[NT_PRFPREG][16 * number : 16 * number + 16] = value.to_bytes(16, "little")
    return image


def flip(image: Image, name: str, bit: int) -> None:
    registers = image.registers()
    registers.put(name, registers.get(name) ^ 1 << bit)
    registers.commit()


@pytest.mark.parametrize("byte", range(8))
def test_every_byte_of_every_general_register(byte: int) -> None:
    for number in range(32):
        image, bit = Image(), 8 * byte + number % 8
        name = "sp" if number == 31 else f"x{number}"
        assert image.registers().get(name) == GENERAL[number]
        flip(image, name, bit)
        assert image.sets == expected({number: GENERAL[number] ^ 1 << bit}).sets
        assert image.written == [NT_PRSTATUS]


@pytest.mark.parametrize("byte", range(16))
def test_every_byte_of_every_vector_register(byte: int) -> None:
    for number in range(32):
        image, bit = Image(), 8 * byte + number % 8
        assert image.registers().get(f"v{number}") == VECTORS[number]
        flip(image, f"q{number}", bit)
        assert image.sets == expected(vectors={number: VECTORS[number] ^ 1 << bit}).sets
        assert image.written == [NT_PRFPREG]


@pytest.mark.parametrize(("name", "width"), [("b7", 8), ("h7", 16), ("s7", 32), ("d7", 64)])
def test_a_part_of_a_vector_changes_nothing_beside_it(name: str, width: int) -> None:
    image = Image()
    assert image.registers().get(name) == VECTORS[7] % 2**width
    flip(image, name, width - 1)
    assert image.sets == expected(vectors={7: VECTORS[7] ^ 1 << width - 1}).sets


def test_the_lower_half_of_a_general_register_changes_nothing_beside_it() -> None:
    image = Image()
    assert image.registers().get("w9") == GENERAL[9] % 2**32
    flip(image, "w9", 31)
    assert image.sets == expected({9: GENERAL[9] ^ 1 << 31}).sets
    assert image.registers().get("fp") == GENERAL[29]
    assert image.registers().get("lr") == GENERAL[30]


def test_flags_are_bits_of_pstate_and_nothing_else_of_it_is_shown() -> None:
    image = Image()
    assert image.registers().get("nzcv") == 0x6000_0000
    assert image.registers().program_counter == PC
    assert not image.registers().in_system_call
    for bit in STATUS_FLAGS:
        flip(image, "nzcv", bit)
    assert image.sets == expected({33: PSTATE ^ 0xF000_0000}).sets
    assert "mask" not in REGISTER_CLASSES


@pytest.mark.parametrize("name", ["xzr", "x31", "v32", "k0", "rax", "p0"])
def test_a_register_that_is_none_is_refused(name: str) -> None:
    with pytest.raises(UnknownRegisterError, match=name):
        Image().registers().get(name)


def test_a_32_bit_thread_is_refused() -> None:
    with pytest.raises(PtraceError, match="32-bit"):
        AArch64Registers(1, lambda *_: bytearray(72), lambda *_: None)


SOURCE: Role = "source"
DESTINATION: Role = "destination"
NZCV = ("nzcv", 32, 0)

ACCESSES: dict[str, tuple[str, set[tuple[str, int, int]], set[tuple[str, int, int]]]] = {
    "2000028b": ("add x0, x1, x2", {("x1", 64, 0), ("x2", 64, 0)}, {("x0", 64, 0)}),
    "2000020b": ("add w0, w1, w2", {("w1", 32, 0), ("w2", 32, 0)}, {("w0", 32, 0)}),
    "1f0002eb": ("cmp x0, x2", {("x0", 64, 0), ("x2", 64, 0)}, {NZCV}),
    "3f000071": ("cmp w1, #0", {("w1", 32, 0)}, {NZCV}),
    "2000029a": ("adc x0, x1, x2", {("x1", 64, 0), ("x2", 64, 0), NZCV}, {("x0", 64, 0)}),
    "20000054": ("b.eq #0x1004", {NZCV}, set()),
    "2010821a": ("csel w0, w1, w2, ne", {("w1", 32, 0), ("w2", 32, 0), NZCV}, {("w0", 32, 0)}),
    "e0031faa": ("mov x0, xzr", set(), {("x0", 64, 0)}),
    "201c0053": ("uxtb w0, w1", {("w1", 32, 0)}, {("w0", 32, 0)}),
    "0050a0f2": ("movk x0, #0x280, lsl #16", {("x0", 64, 0)}, {("x0", 64, 0)}),
    "ff4300d1": ("sub sp, sp, #0x10", {("sp", 64, 0)}, {("sp", 64, 0)}),
    "c0035fd6": ("ret", {("lr", 64, 0)}, set()),
    "20003fd6": ("blr x1", {("x1", 64, 0)}, {("lr", 64, 0)}),
    "1f2003d5": ("nop", set(), set()),
    "2028621e": ("fadd d0, d1, d2", {("d1", 64, 64), ("d2", 64, 64)}, {("d0", 64, 64)}),
    "20d4224e": ("fadd v0.4s, v1.4s, v2.4s", {("v1", 128, 32), ("v2", 128, 32)}, {("v0", 128, 32)}),
    "20d4220e": ("fadd v0.2s, v1.2s, v2.2s", {("v1", 64, 32), ("v2", 64, 32)}, {("v0", 64, 32)}),
    "2084a24e": ("add v0.4s, v1.4s, v2.4s", {("v1", 128, 0), ("v2", 128, 0)}, {("v0", 128, 0)}),
    "20c0221e": ("fcvt d0, s1", {("s1", 32, 32)}, {("d0", 64, 64)}),
    "2000221e": ("scvtf s0, w1", {("w1", 32, 0)}, {("s0", 32, 32)}),
    "2000789e": ("fcvtzs x0, d1", {("d1", 64, 64)}, {("x0", 64, 0)}),
    "2020221e": ("fcmp s1, s2", {("s1", 32, 32), ("s2", 32, 32)}, {NZCV}),
    "2040601e": ("fmov d0, d1", {("d1", 64, 0)}, {("d0", 64, 0)}),
    "e003c03d": ("ldr q0, [sp]", {("sp", 64, 0)}, {("q0", 128, 0)}),
}

MEMORY = {
    "200040f9": [MemoryAccess(SOURCE, 64, base="x1")],  # ldr x0,[x1]
    "20084079": [MemoryAccess(SOURCE, 16, base="x1", displacement=4)],  # ldrh w0,[x1,#4]
    "2000c079": [MemoryAccess(SOURCE, 16, base="x1")],  # ldrsh
    "200080b9": [MemoryAccess(SOURCE, 32, base="x1")],  # ldrsw x0,[x1]
    "410c41f8": [MemoryAccess(SOURCE, 64, base="x2", displacement=16)],  # ldr x1,[x2,#16]!
    "207862f8": [MemoryAccess(SOURCE, 64, base="x1", index="x2", scale=8)],  # ldr x0,[x1,x2,lsl #3]
    "204862f8": [MemoryAccess(SOURCE, 64, base="x1", index="w2")],  # ldr x0,[x1,w2,uxtw]
    "20d862f8": [],  # ldr x0,[x1,w2,sxtw #3]: not offered
    "fd7bbfa9": [MemoryAccess(DESTINATION, 128, base="sp", displacement=-16)],  # stp x29,x30,[sp,#-16]!
    "fd7bc1a8": [MemoryAccess(SOURCE, 128, base="sp")],  # ldp x29,x30,[sp],#16
    "20e0c03c": [MemoryAccess(SOURCE, 128, base="x1", displacement=14)],  # ldur q0,[x1,#14]
    "3f0000b9": [MemoryAccess(DESTINATION, 32, base="x1")],  # str wzr,[x1]
    "20408085": [],  # ldr z0,[x1]: of SVE
    "20fc5f88": [],  # ldaxr: exclusive
    "2000028b": [],  # add
}


@pytest.mark.parametrize(("code", "known"), ACCESSES.items())
def test_registers_roles_widths_and_floats(
    code: str, known: tuple[str, set[tuple[str, int, int]], set[tuple[str, int, int]]]
) -> None:
    found = decode(bytes.fromhex(code) + b"\xff" * 11, 0x1000)
    accesses: dict[Role, set[tuple[str, int, int]]] = {SOURCE: set(), DESTINATION: set()}
    for one in found.candidates:
        accesses[one.role].add((one.register, one.width_bits, one.element_bits))
    assert (found.text, accesses[SOURCE], accesses[DESTINATION]) == known
    assert found.code.hex() == code
    assert found.steppable


@pytest.mark.parametrize(("code", "expected_accesses"), MEMORY.items())
def test_memory_that_is_accessed(code: str, expected_accesses: list[MemoryAccess]) -> None:
    assert list(decode(bytes.fromhex(code), 0x1000).memory) == expected_accesses


def test_whatever_is_decoded_can_be_read() -> None:
    registers, draw, decoded = Image().registers(), generator(1, "code"), 0
    while decoded < 5000:
        with suppress(DecodeError):
            found = decode(draw.bytes(4), 0x1000)
            decoded += 1
            for one in found.candidates:
                registers.get(one.register)
                assert one.width_bits % (one.element_bits or 1) == 0
            for access in found.memory:
                assert access.width_bits > 0
                for name in filter(None, (access.base, access.index)):
                    registers.get(name)


def test_a_system_call_is_not_stepped() -> None:
    assert not decode(bytes.fromhex("010000d4"), 0).steppable


@pytest.mark.parametrize("code", ["", "2000", "ffffffff"])
def test_what_is_no_instruction_is_refused(code: str) -> None:
    with pytest.raises(DecodeError):
        decode(bytes.fromhex(code), 0)
