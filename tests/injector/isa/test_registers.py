"""A flip is what the program itself then sees in its register, and nothing else changes."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest
from iced_x86 import Code, Instruction, Register

from injector.isa import x86_64_xstate
from injector.isa.host import HOST, AbsentError, require
from injector.isa.registers import UnknownRegisterError
from injector.isa.x86_64_registers import GENERAL as PARTS
from injector.isa.x86_64_registers import STATUS_FLAGS, X8664Registers, register_classes
from injector.tracing.ptrace import NT_PRSTATUS, read_registers
from injector.tracing.tracees import TraceeGroup
from services.models.faults.specification import FaultSpec
from tests.injector.faults.test_apply import held, step_to
from tests.injector.programs import (
    GENERAL,
    HAS_AVX,
    HAS_AVX512,
    MASKS,
    VECTOR_BITS,
    VECTORS,
    WIDEST,
    Target,
    assemble,
    running,
)

pytestmark = pytest.mark.usefixtures("may_inject")

PRESENT = {"xmm": True, "ymm": HAS_AVX, "zmm": HAS_AVX512, "k": HAS_AVX512}
GENERAL_VALUES = {name: 0x0123456789ABCDEF * (index + 1) % 2**64 for index, name in enumerate(GENERAL)}
VECTOR_VALUES = {
    number: (0x1F << VECTOR_BITS[WIDEST] - 5 | 0x9E3779B97F4A7C15**5 * (number + 1))
    % 2 ** VECTOR_BITS[WIDEST]
    for number in range(VECTORS)
}
MASK_VALUES = {number: 0x9E3779B97F4A7C15 * (number + 3) % 2**64 for number in range(MASKS)}


@contextmanager
def standing(target: Target) -> Iterator[None]:
    with TraceeGroup() as tracees:
        tracees.seize([target.pid])
        tracees.stop_all()
        yield


def flip(target: Target, name: str, bit: int, value: int) -> None:
    """Flip a bit of a register that has a value, and read it back."""
    registers = X8664Registers(target.pid)
    assert registers.get(name) == value
    registers.put(name, value ^ 1 << bit)
    registers.commit()
    assert X8664Registers(target.pid).get(name) == value ^ 1 << bit


def test_every_byte_of_every_general_register() -> None:
    with running(assemble()) as target:
        for byte in range(8):
            # A different bit of the byte in each register.
            flips = {name: 1 << 8 * byte + index % 8 for index, name in enumerate(GENERAL)}
            target.start(GENERAL_VALUES)
            with TraceeGroup() as tracees:
                tracees.seize([target.pid])
                tracees.stop_all()
                for name, flip in flips.items():
                    registers = X8664Registers(target.pid)
                    assert registers.get(name) == GENERAL_VALUES[name]
                    registers.put(name, registers.get(name) ^ flip)
                    registers.commit()
                    assert X8664Registers(target.pid).get(name) == GENERAL_VALUES[name] ^ flip
            target.finish()
            assert target.general() == {name: GENERAL_VALUES[name] ^ flip for name, flip in flips.items()}


@pytest.mark.parametrize("kind", ["xmm", "ymm", "zmm"])
def test_every_byte_of_every_vector_register(kind: str) -> None:
    width = VECTOR_BITS[kind]
    with running(assemble()) as target:
        target.start()
        if not PRESENT[kind]:
            refused(target, f"{kind}0")
            return
        target.finish()
        for byte in range(width // 8):
            # A different bit of the byte in each register.
            bits = {number: 8 * byte + number % 8 for number in range(VECTORS)}
            target.start(GENERAL_VALUES, VECTOR_VALUES, MASK_VALUES)
            with standing(target):
                for number, bit in bits.items():
                    flip(target, f"{kind}{number}", bit, VECTOR_VALUES[number] % 2**width)
            target.finish()
            assert target.vector() == {
                number: VECTOR_VALUES[number] ^ 1 << bit for number, bit in bits.items()
            }
            assert (target.general(), target.mask()) == (GENERAL_VALUES, MASK_VALUES)


def test_every_byte_of_every_mask_register() -> None:
    with running(assemble()) as target:
        target.start()
        if not PRESENT["k"]:
            refused(target, "k0")
            return
        target.finish()
        for byte in range(8):
            bits = {number: 8 * byte + number for number in range(MASKS)}
            target.start(GENERAL_VALUES, VECTOR_VALUES, MASK_VALUES)
            with standing(target):
                for number, bit in bits.items():
                    flip(target, f"k{number}", bit, MASK_VALUES[number])
            target.finish()
            assert target.mask() == {number: MASK_VALUES[number] ^ 1 << bit for number, bit in bits.items()}
            assert (target.general(), target.vector()) == (GENERAL_VALUES, VECTOR_VALUES)


def refused(target: Target, name: str) -> None:
    with standing(target), pytest.raises(UnknownRegisterError, match=name):
        X8664Registers(target.pid).get(name)


@pytest.mark.parametrize("bit", STATUS_FLAGS)
@pytest.mark.parametrize("was", [0, 1])
def test_every_status_flag_arrives(bit: int, was: int) -> None:
    """The program shows CF, PF, AF, ZF and SF by lahf, OF by seto, and DF by which way scasb goes."""
    shows = [
        Instruction.create(Code.NOPD),
        Instruction.create(Code.LAHF),
        Instruction.create_reg(Code.SETO_RM8, Register.AL),
        Instruction.create_scasb(64),
    ]
    with running(assemble(after=shows)) as target:
        target.start({"rdi": target.address + 100})
        with held(target) as (tracees, thread, process):
            target.go()
            step_to("nop", tracees, thread, process)
            registers = X8664Registers(target.pid)
            assert registers.get("rflags") & ~sum(1 << one for one in STATUS_FLAGS) == 0
            registers.put("rflags", (registers.get("rflags") | 1 << bit) if was else 0)
            registers.commit()
            value = X8664Registers(target.pid).get("rflags")
            flip(target, "rflags", bit, value)
        target.finish()
        rax, rdi = target.general()["rax"], target.general()["rdi"]
        shown = (rax >> 8 & 0b11010101) | (rax & 1) << 11 | (rdi == target.address + 99) << 10
        assert shown == value ^ 1 << bit
        assert shown >> bit & 1 == 1 - was


def test_the_rest_of_the_flags_register_is_not_the_faults() -> None:
    status = sum(1 << one for one in STATUS_FLAGS)
    with running(assemble()) as target:
        target.start(GENERAL_VALUES)
        with standing(target):
            rest = flags_register(target.pid) & ~status
            for value in (2**64 - 1, 0):  # the last, as the direction flag would turn what comes
                registers = X8664Registers(target.pid)
                registers.put("rflags", value)
                registers.commit()
                assert X8664Registers(target.pid).get("rflags") == value & status
                assert flags_register(target.pid) == rest | value & status
        target.finish()
        assert target.general() == GENERAL_VALUES


def flags_register(tid: int) -> int:
    """All of it: the 19th of 27 words of struct user_regs_struct."""
    return int.from_bytes(read_registers(tid, NT_PRSTATUS, 27 * 8)[18 * 8 : 19 * 8], "little")


def test_the_upper_half_of_a_vector_register_that_was_never_used_arrives() -> None:
    clear = [Instruction.create(Code.VEX_VZEROUPPER)] if HAS_AVX else []
    bit = VECTOR_BITS[WIDEST] - 50
    with running(assemble(before=clear)) as target:
        target.start()  # the upper halves are in their initial state
        with standing(target):
            registers = X8664Registers(target.pid)
            registers.put(f"{WIDEST}5", 1 << bit)
            registers.commit()
        target.finish()
        assert target.vector() == {number: 1 << bit if number == 5 else 0 for number in range(VECTORS)}


def test_the_classes_of_this_processor_are_those_that_its_registers_show() -> None:
    with running(assemble()) as target:
        target.start()
        with standing(target):
            shown = HAS_AVX512
            assert (x86_64_xstate.enabled() >> x86_64_xstate.OPMASK & 1 == 1) == shown
            assert ("mask" in HOST.classes()) == shown
            if shown:
                assert X8664Registers(target.pid).get("k0") == 0


def test_a_class_that_the_processor_lacks_is_refused_in_one_line() -> None:
    plain = replace(HOST, classes=lambda: register_classes(enabled=0b111))
    with pytest.raises(AbsentError, match=r"^register class mask absent on this CPU: [^\n]+$"):
        require(FaultSpec(target="pid", register_class="mask"), plain)
    full = replace(HOST, classes=lambda: register_classes(enabled=0b11100111))
    require(FaultSpec(target="pid", register_class="mask"), full)
    require(FaultSpec(target="pid", register_class="any"), plain)


@pytest.mark.parametrize(("fields", "named"), [({"bit_numbers": (3,)}, "bit 3"), ({"bits": 8}, "7 status")])
def test_what_is_no_status_flag_is_refused_in_one_line(fields: dict[str, Any], named: str) -> None:
    with pytest.raises(AbsentError, match=named):
        require(FaultSpec(target="pid", register_class="flags", **fields))


def test_a_part_changes_nothing_beside_it() -> None:
    with running(assemble()) as target:
        for name, part in PARTS.items():
            if part.width == 64:
                continue
            target.start(GENERAL_VALUES)
            with TraceeGroup() as tracees:
                tracees.seize([target.pid])
                tracees.stop_all()
                registers = X8664Registers(target.pid)
                shown = GENERAL_VALUES[part.whole] >> part.shift & (1 << part.width) - 1
                assert registers.get(name) == shown
                registers.put(name, shown ^ 1 << part.width - 1)
                registers.commit()
                changed = X8664Registers(target.pid)
                flip = 1 << part.shift + part.width - 1
                expected = {**GENERAL_VALUES, part.whole: GENERAL_VALUES[part.whole] ^ flip}
                assert {one: changed.get(one) for one in GENERAL} == expected
            target.finish()


def test_writing_registers_does_not_end_a_system_call_that_waits() -> None:
    program = "import sys; print(flush=True); sys.exit(int(sys.stdin.read()))"
    process = subprocess.Popen(
        [sys.executable, "-I", "-S", "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    process.stdout.readline()
    with TraceeGroup() as tracees:
        tracees.seize([process.pid])
        while True:
            tracees.stop_all()
            registers = X8664Registers(process.pid)
            if registers.in_system_call:
                break
            tracees.resume_all()
        registers.put("r15", registers.get("r15"))
        registers.commit()
    process.communicate(b"42")
    assert process.returncode == 42


def test_a_register_that_is_none_is_refused() -> None:
    with running(assemble()) as target, TraceeGroup() as tracees:
        target.start()
        tracees.seize([target.pid])
        tracees.stop_all()
        with pytest.raises(UnknownRegisterError, match="cr0"):
            X8664Registers(target.pid).get("cr0")
