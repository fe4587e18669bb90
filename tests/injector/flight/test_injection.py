"""A whole injection: at the drawn moment, with everybody standing, and nobody traced afterwards."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Literal

import pytest
from iced_x86 import Code, Instruction, MemoryOperand, Register

from injector.faults import approach
from injector.flight.approach import KernelCall
from injector.flight.injection import inject as inject_into
from injector.tracing.process import IdentityError, VanishedError, threads, tracer_of
from services.bus.announce import Announcement, announcement, boot_id, start_ticks
from services.models.faults.specification import FaultSpec, Trigger
from services.models.outcome import InjectionRecord
from services.runtime.rng import generator
from tests.conftest import alive
from tests.injector.doomed import PERIOD_NS
from tests.injector.programs import PATIENCE_S, Target, TargetEndedError, assemble, clock_ns, running, state

pytestmark = pytest.mark.usefixtures("may_inject")

CPU_NS = 2_000_000
VALUE = 0x8123456789ABCDEF
MOVE = Instruction.create_reg_reg(Code.MOV_R64_RM64, Register.RBX, Register.RCX)
MOVE_VECTOR = Instruction.create_reg_reg(Code.MOVAPS_XMM_XMMM128, Register.XMM1, Register.XMM2)
LOAD = Instruction.create_reg_mem(Code.MOV_R64_RM64, Register.RBX, MemoryOperand(Register.RCX))
GETPID = [
    Instruction.create_reg_u32(Code.MOV_R32_IMM32, Register.EAX, 39),
    Instruction.create(Code.SYSCALL),
]


def fault(
    operand: Literal["source", "destination", "any"] = "source",
    register_class: Literal["gpr", "vector", "any"] = "gpr",
    cpu_ns: int = CPU_NS,
) -> FaultSpec:
    trigger = Trigger(invocation=7, cpu_ns=cpu_ns)
    return FaultSpec(target="kernel", operand=operand, register_class=register_class, trigger=trigger)


def inject(
    target: Target,
    others: list[Target],
    spec: FaultSpec,
    seed: int = 0,
    armed: Callable[[], None] = lambda: None,
    finished: Callable[[], bool] = lambda: False,
) -> InjectionRecord:
    call = KernelCall(target.announcement(), 40_000_000, armed, finished)
    return inject_into(call, [other.announcement() for other in others], spec, generator(seed, "test"))


def test_one_bit_of_one_process_is_flipped_and_everybody_goes_on() -> None:
    with running(assemble([MOVE]), threads=3) as target, running(assemble(), threads=2) as other:
        target.start({"rcx": VALUE})
        other.start()
        record = inject(target, [other], fault())
        assert record.status == "injected"
        assert (record.node, record.kernel, record.invocation) == ("node", "kernel", 7)
        assert (record.pid, record.tid, record.virtual_time_ns) == (target.pid, target.pid, 40_000_000)
        assert (record.instruction, record.instruction_bytes) == ("mov rbx,rcx", "488bd9")
        assert (record.operand, record.register_name, record.width_bits) == ("source", "rcx", 64)
        assert record.before == f"{VALUE:016x}"
        (bit,) = record.bits
        assert record.after == record.read_back == f"{VALUE ^ 1 << bit:016x}"
        assert record.threads_stopped == 7
        assert record.pause_us > 0
        assert (record.module, record.build_id, record.symbol) == ("memfd:program", "", "")
        assert target.page[record.offset : record.offset + 3] == bytes.fromhex("488bd9")
        everybody = threads(target.pid) + threads(other.pid)
        assert {tracer_of(tid) for tid in everybody} == {0}
        other.wait_for_progress()
        target.finish()
        assert target.general()["rcx"] == target.general()["rbx"] == VALUE ^ 1 << bit


def test_a_vector_register_is_flipped_where_vectors_are_asked_for() -> None:
    with running(assemble([MOVE, MOVE_VECTOR])) as target:
        target.start(vector={2: VALUE})
        record = inject(target, [], fault(register_class="vector"))
        assert (record.register_name, record.width_bits) == ("xmm2", 128)
        target.finish()
        assert target.vector()[2] == int(record.after, 16) == VALUE ^ 1 << record.bits[0]


@pytest.mark.parametrize("cpu_ns", [0, 300_000, 20_000_000])
def test_the_fault_strikes_after_the_drawn_thread_time(cpu_ns: int) -> None:
    begins: list[int] = []
    with running(assemble([MOVE])) as target:
        target.start()
        record = inject(target, [], fault(cpu_ns=cpu_ns), armed=lambda: begins.append(clock_ns(target.pid)))
        assert record.status == "injected"
        # The scheduler's clock, other than the timer's, leaves out what interrupts took.
        assert clock_ns(target.pid) - begins[0] >= cpu_ns / 2


def test_the_fault_strikes_in_time_though_the_kernel_is_busy_for_the_program() -> None:
    """A moment in kernel mode is lost; the next one is soon."""
    begins: list[int] = []
    late_ns = []
    with running(assemble([MOVE, *GETPID])) as target:
        for seed in range(4):
            target.start()
            spec = fault(cpu_ns=50_000_000)
            record = inject(target, [], spec, seed, armed=lambda: begins.append(clock_ns(target.pid)))
            late_ns.append(clock_ns(target.pid) - begins[-1])
            assert record.status in ("injected", "not_activated")
            target.finish()
    # Once all moments are lost, the injector must run to ask for more; on a full machine it waits for that.
    assert min(late_ns) < 90_000_000


def test_a_call_that_ends_earlier_is_not_reached_and_its_process_lives_on() -> None:
    with running(assemble([MOVE])) as target:
        target.start({"rcx": VALUE})
        end = clock_ns(target.pid) + 3_000_000
        spec = fault(cpu_ns=10**12)
        record = inject(target, [], spec, finished=lambda: clock_ns(target.pid) > end)
        assert record.status == "not_reached"
        assert "before 1000000000000 ns" in record.reason
        target.finish()
        assert target.general()["rcx"] == VALUE


def test_a_trap_that_is_under_way_when_the_call_ends_kills_nobody() -> None:
    with running(assemble([MOVE])) as target:
        target.start()
        for seed in range(40):  # some 20 us of thread time pass until the end of the call is seen
            begin = clock_ns(target.pid)
            spec = fault(cpu_ns=60_000 + 1000 * seed)
            inject(target, [], spec, seed, finished=lambda begin=begin: clock_ns(target.pid) > begin)  # type: ignore[misc]
            target.wait_for_progress(1)
            assert target.process.poll() is None


def test_a_program_without_such_a_register_is_left_as_it_is() -> None:
    with running(assemble([MOVE])) as target:
        target.start({"rcx": VALUE})
        record = inject(target, [], fault(register_class="vector"))
        assert (record.status, record.register_name, record.bits) == ("not_activated", "", [])
        assert record.resampled == 1000
        target.finish()
        assert target.general()["rcx"] == VALUE


def test_system_calls_are_never_flipped_and_never_disturbed() -> None:
    with running(assemble([MOVE, *GETPID])) as target:
        struck = []
        for seed in range(10):
            target.start()
            record = inject(target, [], fault(), seed)
            struck.append(record.instruction if record.status == "injected" else record.status)
            target.finish()
            assert target.general()["rax"] == target.pid
        assert set(struck) <= {"mov rbx,rcx", "not_activated"}
        assert "mov rbx,rcx" in struck


def strike_in_a_hurry(seed: int) -> int:
    """Strike a program that hardly leaves the kernel many times; how often."""
    struck = 0
    with running(assemble([MOVE, *GETPID])) as target:
        for number in range(600):
            target.start()
            record = inject(target, [], fault(), seed + number)
            struck += record.status == "injected"
            target.finish()
    return struck


@pytest.mark.soak
def test_the_trap_comes_on_a_loaded_machine_too() -> None:
    with ProcessPoolExecutor(4, get_context("spawn")) as several:
        assert all(several.map(strike_in_a_hurry, range(0, 4000, 1000)))


def test_a_program_in_system_calls_all_the_time_is_given_up() -> None:
    with running(assemble(GETPID)) as target:
        target.start()
        record = inject(target, [], fault(register_class="vector"))
        assert record.status == "not_activated"
        assert approach.SYSTEM_CALLS <= record.resampled < 4 * approach.SYSTEM_CALLS
        assert "system call" in record.reason
        target.finish()
        assert target.general()["rax"] == target.pid


def test_a_target_that_crashes_of_its_fault_takes_nobody_along() -> None:
    with running(assemble(), threads=2) as other:
        other.start()
        with running(assemble([LOAD])) as target:
            target.start({"rcx": target.address})
            for seed in range(100):
                record = inject(target, [other], fault(), seed)
                assert (record.status, record.register_name) == ("injected", "rcx")
                try:
                    target.wait_for_progress()
                except TargetEndedError:
                    break
            assert target.process.wait(PATIENCE_S) == -signal.SIGSEGV
        other.wait_for_progress()
        assert {tracer_of(tid) for tid in threads(other.pid)} == {0}


def test_a_target_that_dies_before_the_fault_is_told() -> None:
    with running(assemble([MOVE])) as target, running(assemble()) as other:
        target.start()
        other.start()
        record = inject(target, [other], fault(cpu_ns=10**12), armed=target.process.kill)
        assert record.status == "failed"
        assert "died" in record.reason
        other.wait_for_progress()


def test_an_error_on_the_way_lets_go_of_everybody() -> None:
    def fail() -> None:
        raise RuntimeError("the bus is gone")

    with running(assemble([MOVE]), threads=2) as target:
        target.start()
        with pytest.raises(RuntimeError, match="the bus is gone"):
            inject(target, [], fault(cpu_ns=100_000), armed=fail)
        assert {tracer_of(tid) for tid in threads(target.pid)} == {0}
        target.use_time(5_000_000)


def test_a_target_that_is_not_the_announced_one_is_not_touched() -> None:
    with running(assemble([MOVE])) as target:
        target.start()
        wrong = replace(target.announcement(), boot_id="another")
        call = KernelCall(wrong, 0, lambda: None)
        with pytest.raises(IdentityError, match="boot_id"):
            inject_into(call, [], fault(), generator(0, "test"))
        assert tracer_of(target.pid) == 0
        gone = replace(target.announcement(), start_ticks=1)
        with pytest.raises(VanishedError):
            inject_into(KernelCall(gone, 0, lambda: None), [], fault(), generator(0, "test"))


def test_others_that_are_gone_are_left_out() -> None:
    with running(assemble([MOVE])) as target, running(assemble()) as other:
        target.start()
        stale = other.announcement()
        other.process.kill()
        other.process.wait()
        call = KernelCall(target.announcement(), 0, lambda: None)
        record = inject_into(call, [stale], fault(), generator(0, "test"))
        assert (record.status, record.threads_stopped) == ("injected", 1)


MARKED = """
import ctypes, signal, sys, time
ctypes.CDLL(None).prctl(0x59616D61, ctypes.c_ulong(-1), 0, 0, 0)
def burn(duration_ns):
    end = time.thread_time_ns() + duration_ns
    while time.thread_time_ns() < end: sum(range(1000))
print(flush=True)
sys.stdin.readline()
burn(5_000_000)
signal.raise_signal(signal.SIGURG)
burn(5_000_000)
signal.raise_signal(signal.SIGURG)
print(sys.stdin.read() + "ended", flush=True)
"""


@pytest.mark.parametrize(
    ("cpu_ns", "status"), [(4_000_000, {"injected", "not_activated"}), (8_000_000, {"not_reached"})]
)
def test_thread_time_counts_between_the_marks_of_a_call(cpu_ns: int, status: set[str]) -> None:
    """Before the first mark 5 ms pass, between the marks another 5."""
    process = subprocess.Popen(
        [sys.executable, "-I", "-S", "-c", MARKED], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    assert process.stdin is not None
    process.stdout.readline()
    stdin = process.stdin

    def begin() -> None:
        stdin.write(b"begin\n")
        stdin.flush()

    target = Announcement("node", process.pid, process.pid, start_ticks(process.pid), boot_id())
    call = KernelCall(target, 0, armed=begin, marked=True)
    # No vector register is in use in Python's loop, or none that matters.
    record = inject_into(call, [], fault(register_class="vector", cpu_ns=cpu_ns), generator(0, "test"))
    assert record.status in status
    assert process.communicate()[0] == b"ended\n"


def test_a_target_that_comes_to_neither_place_nor_end_is_no_result_but_an_error() -> None:
    with running(assemble([MOVE])) as target:
        target.start({"rcx": VALUE})
        call = KernelCall(target.announcement(), 0, lambda: None)
        never = fault(cpu_ns=10**15)
        with pytest.raises(TimeoutError, match=r"within 0\.3 s"):
            inject_into(call, [], never, generator(0, "test"), limit_s=0.3)
        assert tracer_of(target.pid) == 0
        assert alive(target.pid)


def test_a_fault_without_a_trigger_is_refused() -> None:
    call = KernelCall(announcement("node"), 0, lambda: None)
    with pytest.raises(ValueError, match="trigger"):
        inject_into(call, [], FaultSpec(target="kernel"), generator(0, "test"))


@pytest.mark.parametrize("stage", ["timed", "trapped", "standing", "stepped"])
def test_targets_of_an_injector_that_is_killed_live_on_untraced(stage: str) -> None:
    with running(assemble([MOVE]), threads=3) as target:
        target.start({"rcx": VALUE})
        if stage == "timed":  # the trap is to come after the end of the injector
            os.kill(target.pid, signal.SIGSTOP)
        injector = subprocess.Popen(
            [sys.executable, "-m", "tests.injector.doomed", stage, str(target.pid)],
            cwd=Path(__file__).parents[3],
            stdout=subprocess.PIPE,
        )
        try:
            assert injector.stdout is not None
            assert injector.stdout.readline() == b"here\n"
            time.sleep(0.05)  # several heartbeats of a pause
            assert tracer_of(target.pid) == injector.pid
        finally:
            injector.kill()
            injector.communicate()
        os.kill(target.pid, signal.SIGCONT)
        assert {tracer_of(tid) for tid in threads(target.pid)} == {0}
        target.use_time(3 * PERIOD_NS)
        target.wait_for_progress()
        assert {state(tid) for tid in threads(target.pid)} <= {"R", "S"}
        target.finish()
        assert target.general()["rcx"] == VALUE
