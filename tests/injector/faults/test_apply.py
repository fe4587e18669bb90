"""A fault strikes one eligible register of one instruction, and the program sees it."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

import pytest
from iced_x86 import Code, Instruction, Register

from injector.faults.apply import SITES, apply_fault
from injector.faults.stopped_thread import InjectionResult, stand, step
from injector.isa.registers import Registers
from injector.tracing.process import Process, ProcessIdentity
from injector.tracing.tracee import Tracee
from injector.tracing.tracees import TraceeGroup
from services.models.faults.specification import FaultSpec
from services.runtime.rng import generator
from tests.injector.programs import Target, assemble, running

pytestmark = pytest.mark.usefixtures("may_inject")

Operand = Literal["source", "destination", "any"]

MOVE = Instruction.create_reg_reg(Code.MOV_R64_RM64, Register.RBX, Register.RCX)
MOVE_32 = Instruction.create_reg_reg(Code.MOV_R32_RM32, Register.EBX, Register.ECX)
MOVE_VECTOR = Instruction.create_reg_reg(Code.MOVAPS_XMM_XMMM128, Register.XMM1, Register.XMM2)
ADD_SCALAR = Instruction.create_reg_reg(Code.ADDSD_XMM_XMMM64, Register.XMM1, Register.XMM2)
ADD = Instruction.create_reg_reg(Code.ADD_R64_RM64, Register.RBX, Register.RCX)
VALUE = 0x8123456789ABCDEF


def fault(operand: Operand = "any", register_class: Literal["gpr", "vector", "any"] = "any") -> FaultSpec:
    return FaultSpec(target="kernel", operand=operand, register_class=register_class)


@contextmanager
def held(target: Target) -> Iterator[tuple[TraceeGroup, Tracee, Process]]:
    with Process(ProcessIdentity.announced(target.announcement())) as process, TraceeGroup() as tracees:
        tracees.seize([target.pid])
        tracees.stop_all()
        yield tracees, tracees.threads[target.pid], process


def step_to(text: str, tracees: TraceeGroup, thread: Tracee, process: Process) -> Registers:
    for _ in range(100):
        registers, instruction = stand(thread, process)
        if instruction.text == text:
            return registers
        step(tracees, thread, instruction)
    raise AssertionError(text)


def inverted(found: InjectionResult) -> int:
    return sum(1 << bit for bit in found.bits)


def strike_at(target: Target, text: str, spec: FaultSpec, seed: int) -> InjectionResult:
    """End the spinning, and strike where the program comes to ``text``."""
    with held(target) as (tracees, thread, process):
        target.go()
        step_to(text, tracees, thread, process)
        found = apply_fault(tracees, thread, process, spec, generator(seed, "test"))
    target.finish()
    assert found is not None
    assert found.status == "injected"
    assert found.instruction is not None
    assert found.instruction.text == text
    assert found.read_back == found.after == found.before ^ inverted(found)
    return found


@pytest.mark.parametrize(("move", "text", "width"), [(MOVE, "mov rbx,rcx", 64), (MOVE_32, "mov ebx,ecx", 32)])
def test_a_flipped_destination_survives_its_instruction(move: Instruction, text: str, width: int) -> None:
    moved = VALUE % 2**width
    with running(assemble(after=[move])) as target:
        for seed in range(8):
            target.start({"rcx": VALUE, "rbx": 1})
            found = strike_at(target, text, fault("destination", "gpr"), seed)
            assert found.width_bits == width
            assert found.before == moved
            assert target.general()["rbx"] == moved ^ inverted(found)
            assert target.general()["rcx"] == VALUE


def test_a_flipped_source_is_what_the_instruction_takes() -> None:
    with running(assemble(after=[MOVE])) as target:
        for seed in range(8):
            target.start({"rcx": VALUE, "rbx": 1})
            found = strike_at(target, "mov rbx,rcx", fault("source"), seed)
            assert target.general()["rbx"] == target.general()["rcx"] == VALUE ^ inverted(found)


def test_a_flipped_vector_destination_survives_its_instruction() -> None:
    with running(assemble(after=[MOVE_VECTOR])) as target:
        bits = set()
        for seed in range(8):
            target.start(vector={2: VALUE << 64 | VALUE})
            found = strike_at(target, "movaps xmm1,xmm2", fault("destination", "vector"), seed)
            assert target.vector()[1] == (VALUE << 64 | VALUE) ^ inverted(found)
            bits.add(found.bits[0] // 64)
        assert bits == {0, 1}  # in both halves


def test_a_scalar_instruction_is_struck_in_its_element() -> None:
    with running(assemble(after=[ADD_SCALAR])) as target:
        for seed in range(8):
            target.start()
            found = strike_at(target, "addsd xmm1,xmm2", fault("source"), seed)
            assert found.width_bits == 64


def test_what_is_read_and_written_is_drawn_as_each() -> None:
    with running(assemble(after=[ADD])) as target:
        drawn = set()
        for seed in range(30):
            target.start({"rcx": VALUE, "rbx": 5})
            found = strike_at(target, "add rbx,rcx", fault(register_class="gpr"), seed)
            name, role, bit = found.register, found.operand, found.bits[0]
            drawn.add((name, role))
            rbx, rcx = 5, VALUE
            if name == "rcx":
                rcx ^= 1 << bit
            elif role == "source":
                rbx ^= 1 << bit
            total = (rbx + rcx) % 2**64
            assert target.general()["rbx"] == (total ^ 1 << bit if role == "destination" else total)
        assert drawn == {("rbx", "source"), ("rbx", "destination"), ("rcx", "source")}


def test_the_same_draws_strike_the_same_bit() -> None:
    with running(assemble(after=[ADD])) as target:
        strikes = []
        for _ in range(2):
            target.start({"rcx": VALUE})
            strikes.append(strike_at(target, "add rbx,rcx", fault(), 3))
        assert strikes[0] == strikes[1]


def test_instructions_without_an_eligible_register_are_passed_over_and_counted() -> None:
    with running(assemble(after=[MOVE])) as target:
        target.start({"rcx": VALUE})
        with held(target) as (tracees, thread, process):
            target.go()
            found = apply_fault(tracees, thread, process, fault("source", "gpr"), generator(0, "test"))
        target.finish()
        assert found is not None
        assert found.instruction is not None
        assert found.instruction.text == "mov rbx,rcx"
        assert 1 <= found.passed_over <= 6
        assert target.general()["rcx"] == VALUE ^ inverted(found)


def test_a_program_that_never_offers_one_is_left_as_it_is() -> None:
    with running(assemble()) as target:
        target.start({"rcx": VALUE})
        with held(target) as (tracees, thread, process):
            found = apply_fault(tracees, thread, process, fault("any", "vector"), generator(0, "test"))
        target.finish()
        assert found is not None
        assert (found.status, found.passed_over) == ("not_activated", SITES)
        assert found.reason
        assert target.general()["rcx"] == VALUE


def test_a_system_call_is_no_place_to_strike() -> None:
    process = subprocess.Popen(
        [sys.executable, "-I", "-S", "-c", "import sys; sys.exit(int(sys.stdin.read()))"],
        stdin=subprocess.PIPE,
    )
    with Process(ProcessIdentity.of(process.pid)) as held_process, TraceeGroup() as tracees:
        tracees.seize([process.pid])
        thread = tracees.threads[process.pid]
        while True:  # until it reads
            tracees.stop_all()
            if stand(thread, held_process)[0].in_system_call:
                break
            tracees.resume_all()
        for seed in range(10):
            assert apply_fault(tracees, thread, held_process, fault(), generator(seed, "test")) is None
    process.communicate(b"42")
    assert process.returncode == 42  # it went on reading


def test_a_target_killed_while_it_stands_makes_the_attempt_fail() -> None:
    with running(assemble(after=[MOVE])) as target:
        target.start()
        with held(target) as (tracees, thread, process):
            target.process.kill()
            found = apply_fault(tracees, thread, process, fault("destination", "gpr"), generator(0, "test"))
        assert found is not None
        assert found.status == "failed"
        assert found.reason
