"""What each fault model does is what the program then prints."""

import ctypes
import os
import signal
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from injector.faults.apply import apply_fault
from injector.faults.opcode import corrupt
from injector.faults.record import record_of
from injector.faults.stopped_thread import InjectionResult, stand, step
from injector.isa.host import decode
from injector.tracing.process import Process, ProcessIdentity
from services.models.faults.specification import FaultSpec
from services.models.outcome import InjectionRecord
from services.runtime.rng import generator
from tests.injector.c_programs import Program, assembly, compiled, kill, running_program
from tests.injector.faults.test_apply import held
from tests.injector.programs import assemble, running

pytestmark = pytest.mark.usefixtures("may_inject")

CELL = 'static volatile long cell[2] __asm__("cell") __attribute__((used)) = {5, 0};'


@contextmanager
def program(folder: Path, *lines: str, declarations: str = "") -> Iterator[Program]:
    with running_program(compiled(folder, assembly(lines, declarations))) as one:
        yield one


def strike_at(one: Program, text: str, seed: int = 0, **fields: Any) -> InjectionResult:
    """Strike where the kernel first comes to ``text``."""
    with one.at_kernel() as (tracees, thread, process):
        while not (instruction := stand(thread, process)[1]).text.startswith(text):
            step(tracees, thread, instruction)
        fault = FaultSpec(target="kernel", **fields)
        found = apply_fault(tracees, thread, process, fault, generator(seed, "test"))
        assert found is not None
        assert found.passed_over == 0
        code = process.read_code(instruction.address)[: len(instruction.code)]
        assert code == instruction.code  # whatever was done to it
    record = record_of(found, fault, node="", kernel="", invocation=0)
    assert InjectionRecord.model_validate_json(record.model_dump_json(by_alias=True)) == record
    assert (record.status, int(record.after, 16), record.bits) == (found.status, found.after, [*found.bits])
    return found


COUNT = ["xor %%eax,%%eax", "mov $1,%%ebx", *["add %%rbx,%%rax"] * 10]


@pytest.mark.parametrize(("held", "counted"), [(1, 9), (2, 8), (4, 6), (9, 1)])
def test_a_bit_stuck_at_0_is_forced_before_each_instruction(tmp_path: Path, held: int, counted: int) -> None:
    with program(tmp_path, *COUNT) as one:
        found = strike_at(
            one,
            "add",
            model="stuck_at",
            stuck_value=0,
            stuck_instructions=held,
            bit_numbers=(0,),
            operand="destination",
            register_class="gpr",
        )
        assert (found.status, found.register, found.before, found.after) == ("injected", "rax", 1, 0)
        assert found.held_instructions == held
        assert one.result() == str(counted)
        assert one.round() == "10"


def test_a_bit_stuck_at_1_holds_against_what_clears_it(tmp_path: Path) -> None:
    with program(tmp_path, "mov $0,%%ebx", *["and $0,%%rbx"] * 5, "mov %%rbx,%%rax") as one:
        found = strike_at(
            one,
            "and",
            model="stuck_at",
            stuck_value=1,
            stuck_instructions=6,
            bit_numbers=(7,),
            operand="source",
        )
        assert (found.register, found.held_instructions) == ("rbx", 6)
        assert one.result() == "128"


def test_a_bit_that_was_so_all_the_time_is_not_activated(tmp_path: Path) -> None:
    with program(tmp_path, *COUNT) as one:
        stuck: dict[str, Any] = {
            "model": "stuck_at",
            "stuck_value": 0,
            "stuck_instructions": 5,
            "bit_numbers": (40,),
        }
        found = strike_at(one, "add", **stuck, register_class="gpr")
        assert found.status == "not_activated"
        assert "0 already" in found.reason
        assert one.result() == "10"


def test_holding_ends_at_a_system_call(tmp_path: Path) -> None:
    with program(tmp_path, "mov $39,%%eax", "mov $3,%%ebx", "syscall", "mov %%rbx,%%rax") as one:
        stuck: dict[str, Any] = {
            "model": "stuck_at",
            "stuck_value": 1,
            "stuck_instructions": 100,
            "bit_numbers": (6,),
        }
        found = strike_at(one, "mov ebx,3", **stuck, operand="destination")
        assert (found.status, found.held_instructions) == ("injected", 1)
        assert found.reason == "held until syscall"
        assert one.result() == "67"


ADDITIONS = ["mov $100,%%eax", "mov $7,%%ebx", "mov $5,%%ecx", "1: add %%rbx,%%rax", "dec %%ecx", "jnz 1b"]


def test_a_corrupted_instruction_is_executed_once(tmp_path: Path) -> None:
    with program(tmp_path, *ADDITIONS) as one:
        found = strike_at(one, "add rax,rbx", model="opcode", bit_numbers=(11, 13))
        assert (found.status, found.instruction_after) == ("injected", "sub rax,rbx")
        assert (found.width_bits, found.before, found.after) == (24, 0xD80148, 0xD82948)
        assert found.read_back == found.after
        assert one.result() == "121"
        assert one.round() == "135"


def test_what_is_no_instruction_ends_the_program_but_not_the_next(tmp_path: Path) -> None:
    path = compiled(tmp_path, assembly(ADDITIONS))
    with running_program(path) as one:
        found = strike_at(one, "add rax,rbx", model="opcode", bit_numbers=(8, 9, 10))
        assert (found.status, found.instruction_after) == ("injected", "(no instruction)")
        assert found.reason == f"it raised signal {signal.SIGILL.value}"
        assert one.result() == ""
        assert one.process.wait() == -signal.SIGILL
    with running_program(path) as one:
        assert one.round() == "135"  # the file is as it was


def test_code_that_others_share_is_not_corrupted() -> None:
    with running(assemble()) as target:
        before = target.page[:8192]
        target.start()
        with held(target) as (tracees, thread, process):
            found = apply_fault(
                tracees, thread, process, FaultSpec(target="kernel", model="opcode"), generator(0, "test")
            )
            assert found is not None
            assert found.status == "failed"
            assert "shared" in found.reason
        assert target.page[:8192] == before


def test_an_instruction_is_restored_though_a_signal_comes(tmp_path: Path) -> None:
    with program(tmp_path, *ADDITIONS) as one, one.at_kernel() as (tracees, thread, process):
        kill(one, signal.SIGUSR2)
        fault = FaultSpec(target="kernel", model="opcode", seed=1)
        found = apply_fault(tracees, thread, process, fault, generator(1, "test"))
        assert found is not None
        assert found.status == "injected"
        assert found.instruction is not None
        assert process.read_code(found.instruction.address).startswith(found.instruction.code)


def test_corruption_makes_no_system_call() -> None:
    code = ctypes.create_string_buffer(
        bytes.fromhex("0f0d08") + b"\x90" * 12
    )  # prefetchw [rax]; 0f05: syscall
    address = ctypes.addressof(code)
    seen: set[int] = set()
    fault = FaultSpec(target="pid", model="opcode")
    with Process(ProcessIdentity.of(os.getpid())) as own:
        draw = generator(0, "test")
        instruction = decode(code.raw[:15], address)
        for _ in range(300):
            found = corrupt(instruction, own, fault, draw)
            assert found is not None
            seen.update(found.bits)
        assert seen == set(range(24)) - {11}
        named = FaultSpec(target="pid", model="opcode", bit_numbers=(11,))
        assert corrupt(instruction, own, named, draw) is None


def test_memory_that_is_read_stays_corrupted(tmp_path: Path) -> None:
    with program(tmp_path, "mov cell(%%rip),%%rax", declarations=CELL) as one:
        found = strike_at(one, "mov rax", model="memory", bits=2)
        assert (found.status, found.operand, found.width_bits, found.before) == ("injected", "source", 64, 5)
        assert (found.before ^ found.after).bit_count() == 2
        expected = str(struct.unpack("<q", found.after.to_bytes(8, "little"))[0])
        assert float(one.result()) == float(expected)
        assert float(one.round()) == float(expected)


@pytest.mark.parametrize(("mask", "width"), [("byte", 8), ("word", 32)])
def test_a_byte_or_word_of_memory_takes_another_value(tmp_path: Path, mask: str, width: int) -> None:
    with program(tmp_path, "mov cell(%%rip),%%rax", declarations=CELL) as one:
        found = strike_at(one, "mov rax", model="memory", mask=mask)
        changed = found.before ^ found.read_back
        assert changed == sum(1 << bit for bit in found.bits) > 0
        assert found.bits[0] // width == found.bits[-1] // width
        expected = str(struct.unpack("<q", found.after.to_bytes(8, "little"))[0])
        assert float(one.result()) == float(expected)


def test_the_bits_of_a_mask_are_held(tmp_path: Path) -> None:
    with program(tmp_path, *COUNT) as one:
        found = strike_at(
            one,
            "add",
            model="stuck_at",
            stuck_value=1,
            stuck_instructions=9,
            mask="histogram",
            histogram={"masks": {"0x30": 1.0}},
            operand="destination",
            register_class="gpr",
        )
        assert (found.register, found.bits, found.before, found.after) == ("rax", (4, 5), 1, 0x31)
        assert found.held_instructions == 9
        assert one.result() == str(0x3A)


def test_memory_that_is_written_is_corrupted_after_that(tmp_path: Path) -> None:
    lines = ["movb $9,cell+3(%%rip)", "mov cell(%%rip),%%rax"]
    with program(tmp_path, *lines, declarations=CELL) as one:
        found = strike_at(one, "mov byte ptr", model="memory", bit_numbers=(2,), operand="destination")
        assert (found.width_bits, found.before, found.after) == (8, 9, 13)
        assert one.result() == str(5 + (13 << 24))
        assert one.round() == str(5 + (9 << 24))  # written anew


def test_constants_can_be_corrupted_too(tmp_path: Path) -> None:
    declarations = "static const volatile double number = 1.5; double kernel(void) { return 1.0 + number; }"
    path = compiled(tmp_path, declarations)
    with running_program(path) as one:
        found = strike_at(one, "movsd xmm0", model="memory", field="sign")
        assert (found.status, found.element_bits, found.bits) == ("injected", 64, (63,))
        assert float(one.result()) in (0.5, -0.5)
    with running_program(path) as one:
        assert one.round() == "2.5"


FLOATS = "volatile double a[2] = {1.5, 2.5}; double kernel(void) { return a[0] * a[1]; }"


@pytest.mark.parametrize(
    ("field", "bits"), [("sign", {63}), ("exponent", {*range(52, 63)}), ("mantissa", {*range(52)})]
)
def test_a_field_of_a_number_in_a_register(tmp_path: Path, field: str, bits: set[int]) -> None:
    path = compiled(tmp_path, FLOATS)
    for seed in range(4):
        with running_program(path) as one:
            found = strike_at(one, "mulsd", seed, field=field, operand="destination")
            assert (found.register, found.width_bits, found.element_bits) == ("xmm0", 64, 64)
            assert set(found.bits) <= bits
            assert found.before == int.from_bytes(struct.pack("<d", 3.75), "little")
            (value,) = struct.unpack("<d", found.after.to_bytes(8, "little"))
            assert float(one.result()) == value


def test_a_flag_that_a_jump_reads_turns_it(tmp_path: Path) -> None:
    with program(tmp_path, "mov $1,%%eax", "cmp $1,%%eax", "je 1f", "mov $2,%%eax", "1: nop") as one:
        found = strike_at(one, "je", register_class="flags")
        assert (found.register, found.bits, found.before & 64, found.after & 64) == ("rflags", (6,), 64, 0)
        assert one.result() == "2"
        assert one.round() == "1"


def test_the_dummy_changes_nothing_and_says_what_it_would_have(tmp_path: Path) -> None:
    with program(tmp_path, *ADDITIONS) as one:
        for seed in range(20):
            found = strike_at(one, "add", seed, model="none", bits=2)
            assert found.status == "not_activated"
            assert found.before == found.after == found.read_back
            assert len(found.bits) == 2
            assert one.result() == "135"
