"""The record of an injection says what was corrupted and where, and nothing of what was not."""

from injector.faults.record import record_of
from injector.faults.stopped_thread import InjectionResult
from injector.isa.instruction import Instruction
from injector.tracing.elf import CodeLocation
from services.models.faults.specification import FaultSpec

FAULT = FaultSpec(target="pid", scope="kernel")
ADD = Instruction(0x1000, bytes.fromhex("4801d8"), "add rax,rbx", steppable=True, candidates=(), memory=())


def nowhere(_: int) -> CodeLocation:
    raise AssertionError("there is no instruction to be located")


def test_an_injection_is_told_with_its_values_and_its_location() -> None:
    result = InjectionResult(
        "injected",
        instruction=ADD,
        operand="source",
        register="rbx",
        width_bits=12,
        bits=(4,),
        before=0x0A,
        after=0x1A,
        read_back=0x1A,
        passed_over=2,
    )
    record = record_of(
        result,
        FAULT,
        node="control",
        kernel="pid",
        invocation=7,
        location=lambda address: CodeLocation("libpid.so", "ab", address - 0x1000, "step"),
        precision="exact",
        tid=5,
    )
    assert (record.status, record.precision, record.scope, record.tid) == ("injected", "exact", "kernel", 5)
    assert (record.module, record.build_id, record.offset, record.symbol) == ("libpid.so", "ab", 0, "step")
    assert (record.instruction, record.instruction_bytes) == ("add rax,rbx", "4801d8")
    assert (record.register_name, record.bits, record.resampled) == ("rbx", [4], 2)
    assert (record.before, record.after, record.read_back) == ("00a", "01a", "01a")


def test_one_that_reached_no_instruction_has_only_its_reason() -> None:
    record = record_of(
        InjectionResult("not_reached", "too late"),
        FAULT,
        node="control",
        kernel="pid",
        invocation=7,
        location=nowhere,
    )
    assert (record.status, record.reason, record.module, record.before) == ("not_reached", "too late", "", "")
