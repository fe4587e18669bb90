"""A flip is what the program itself then sees in its register, and nothing else changes."""

import subprocess
import sys

import pytest
from iced_x86 import Code, Instruction

from injector.freeze import Tracees
from injector.registers import UnknownRegisterError
from injector.x86_64 import GENERAL as PARTS
from injector.x86_64 import X8664Registers
from tests.injector.programs import GENERAL, HAS_AVX, assemble, running

WIDTH = 256 if HAS_AVX else 128
GENERAL_VALUES = {name: 0x0123456789ABCDEF * (index + 1) % 2**64 for index, name in enumerate(GENERAL)}
VECTOR_VALUES = {number: (0x1F << 251 | 0x9E3779B97F4A7C15 * (number + 1)) % 2**WIDTH for number in range(16)}


def test_every_byte_of_every_general_register() -> None:
    with running(assemble()) as target:
        for byte in range(8):
            # A different bit of the byte in each register.
            flips = {name: 1 << 8 * byte + index % 8 for index, name in enumerate(GENERAL)}
            target.start(GENERAL_VALUES)
            with Tracees() as tracees:
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


def test_every_byte_of_every_vector_register() -> None:
    kind = "ymm" if HAS_AVX else "xmm"
    with running(assemble()) as target:
        for byte in range(WIDTH // 8):
            flips = {number: 1 << 8 * byte + number % 8 for number in range(16)}
            target.start(GENERAL_VALUES, VECTOR_VALUES)
            with Tracees() as tracees:
                tracees.seize([target.pid])
                tracees.stop_all()
                for number, flip in flips.items():
                    registers = X8664Registers(target.pid)
                    assert registers.get(f"{kind}{number}") == VECTOR_VALUES[number]
                    registers.put(f"{kind}{number}", VECTOR_VALUES[number] ^ flip)
                    registers.commit()
                    assert X8664Registers(target.pid).get(f"{kind}{number}") == VECTOR_VALUES[number] ^ flip
            target.finish()
            assert target.vector() == {number: VECTOR_VALUES[number] ^ flip for number, flip in flips.items()}
            assert target.general() == GENERAL_VALUES


@pytest.mark.skipif(not HAS_AVX, reason="this processor has no ymm registers")
def test_the_upper_half_of_a_vector_register_that_was_never_used_arrives() -> None:
    with running(assemble(before=[Instruction.create(Code.VEX_VZEROUPPER)])) as target:
        target.start()  # the upper halves are in their initial state
        with Tracees() as tracees:
            tracees.seize([target.pid])
            tracees.stop_all()
            registers = X8664Registers(target.pid)
            registers.put("ymm5", 1 << 200)
            registers.commit()
        target.finish()
        assert target.vector() == {number: 1 << 200 if number == 5 else 0 for number in range(16)}


def test_a_part_changes_nothing_beside_it() -> None:
    with running(assemble()) as target:
        for name, part in PARTS.items():
            if part.width == 64:
                continue
            target.start(GENERAL_VALUES)
            with Tracees() as tracees:
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
    with Tracees() as tracees:
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
    with running(assemble()) as target, Tracees() as tracees:
        target.start()
        tracees.seize([target.pid])
        tracees.stop_all()
        with pytest.raises(UnknownRegisterError, match="rip"):
            X8664Registers(target.pid).get("rip")
