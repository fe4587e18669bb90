"""A process that knows nothing of us is struck where it was asked for, and lives on untraced."""

import itertools
import os
import signal
import subprocess
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from injector.attach import injection
from injector.attach.approach import AttachTarget
from injector.attach.function_calls import CalledFunction
from injector.attach.injection import ProcessInjection, inject_into
from injector.attach.permission import admit
from injector.attach.untrapped_tracees import notice_for
from injector.faults.code_restorer import RestoredProcess
from injector.tracing.process import Process, threads, tracer_of
from injector.tracing.symbols import function_at, module_code, variants_of
from services.models.faults.specification import FaultSpec
from services.runtime.rng import generator
from tests.injector.cpp_program import mapper, running_program
from tests.injector.programs import clock_ns, state

pytestmark = pytest.mark.usefixtures("may_inject")

__all__ = ["mapper"]

INSERT, LENGTHY = "_ZN4grid6insertEdi", "lengthy"


def inject(
    pid: int, aim: dict[str, Any], seed: int = 0, dry_run: bool = False, watch_s: float = 0.2, **fields: Any
) -> ProcessInjection:
    fault = FaultSpec(target="any", seed=seed, **fields)
    kind = RestoredProcess if fault.model == "opcode" else Process
    with admit(pid, kind) as process:
        maps = process.maps()
        symbol, module = aim.pop("symbol", ""), aim.pop("module", "")
        found = AttachTarget(
            tids=aim.pop("tids", tuple(threads(pid)) if symbol else (pid,)),
            function=CalledFunction(variants_of(pid, maps, symbol)) if symbol else None,
            code=module_code(maps, module) if module else (),
            **aim,
        )
        draw = generator(seed, "any process")
        return inject_into(process, found, fault, draw, dry_run=dry_run, watch_s=watch_s)


def lives_untraced(process: subprocess.Popen[bytes]) -> bool:
    everybody = threads(process.pid)
    busy = everybody[1]  # never sleeps
    begin = clock_ns(busy)
    deadline = time.monotonic() + 30
    while clock_ns(busy) < begin + 1_000_000 and time.monotonic() < deadline:
        if process.poll() is not None:
            return False
    return (
        process.poll() is None
        and {tracer_of(tid) for tid in everybody} == {0}
        and not {state(tid) for tid in everybody} & set("tT")
    )


def test_a_function_of_a_library_is_struck_in_whichever_thread_calls_it(mapper: Path) -> None:
    with running_program(mapper) as process:
        done = inject(process.pid, {"symbol": INSERT}, operand="source", register_class="vector")
        record = done.injection
        assert record.status == "injected", record.reason
        assert (record.module, record.symbol, record.precision) == ("libgrid.so", INSERT, "rehearsed")
        assert record.tid in threads(process.pid)[1:]
        assert int(record.after, 16) == int(record.before, 16) ^ 1 << record.bits[0]
        assert record.read_back == record.after
        assert record.threads_stopped == 4
        assert done.rehearsals == 2
        assert done.instructions is not None
        assert 100 < done.instructions < 1000
        assert done.step is not None
        assert 0 <= done.step < done.instructions
        assert done.aftermath.result == "lives"
        assert lives_untraced(process)


@pytest.mark.soak
def test_every_instruction_of_the_call_can_be_named_by_its_number(mapper: Path) -> None:
    """The steps are those of the code: the loop comes round every so many."""
    with running_program(mapper) as process:
        seen = [
            inject(process.pid, {"symbol": INSERT, "step": step}, dry_run=True, watch_s=0).injection
            for step in range(60)
        ]
        assert {one.precision for one in seen} == {"exact"}
        with admit(process.pid) as held:
            entry, _ = function_at(process.pid, held.maps(), INSERT)
            first = held.read_code(entry)
        assert first.hex().startswith(seen[0].instruction_bytes)
        loop = [number for number, one in enumerate(seen) if one.instruction.startswith("divsd")]
        assert len(loop) > 2
        assert len({after - before for before, after in itertools.pairwise(loop)}) == 1
        period = loop[1] - loop[0]
        body = [one.offset for one in seen[loop[0] :]]
        assert body[period:] == body[:-period]
        past = inject(process.pid, {"symbol": INSERT, "step": 100_000}, dry_run=True)
        assert past.injection.status == "not_reached"
        assert lives_untraced(process)


def test_a_dry_run_does_all_but_the_flip(mapper: Path) -> None:
    with running_program(mapper) as process:
        for model in ("bitflip", "memory", "opcode"):
            done = inject(process.pid, {"symbol": INSERT}, 2, dry_run=True, model=model)
            assert (done.injection.status, done.injection.model) == ("not_activated", model)
            assert "dry run" in done.injection.reason
            assert done.injection.bits
            assert done.injection.before == done.injection.after == done.injection.read_back
            wet = inject(process.pid, {"symbol": INSERT}, 2, dry_run=True, model=model)
            assert (wet.injection.offset, wet.injection.bits) == (done.injection.offset, done.injection.bits)
        assert lives_untraced(process)


def test_a_long_call_is_struck_where_it_was_asked_for(mapper: Path) -> None:
    for seed in range(3):
        with running_program(mapper) as process:  # another each time: what is struck may end
            done = inject(
                process.pid, {"symbol": LENGTHY, "cpu_s": (0.001, 0.002)}, seed, register_class="flags"
            )
            assert (done.injection.status, done.injection.precision) == ("injected", "cpu_time"), (
                done.injection.reason
            )
            assert "lengthy" in done.injection.symbol
            assert done.cpu_ns is not None
            assert 1_000_000 <= done.cpu_ns <= 2_000_000
    with running_program(mapper) as process:
        done = inject(process.pid, {"symbol": LENGTHY}, seed=3, dry_run=True)  # an early pass is drawn
        assert (done.injection.precision, done.rehearsals) == ("exact", 1), done.uncounted
        assert done.instructions is not None
        assert done.instructions > 30_000_000  # passes of its loop
        assert lives_untraced(process)


def test_only_code_of_the_library_is_struck(mapper: Path) -> None:
    with running_program(mapper) as process:
        busy = threads(process.pid)[1]
        for seed in range(3):
            aim = {"module": "mapper", "tids": (busy,)}
            record = inject(process.pid, aim, seed, dry_run=True).injection
            assert (record.module, record.tid, record.precision) == ("mapper", busy, "cpu_time")
        missed = inject(process.pid, {"module": "libm", "tids": (busy,), "limit_s": 1.0}).injection
        assert missed.status == "not_reached"
        assert "libm" in missed.reason
        assert "never in" in missed.reason


def test_a_thread_is_struck_after_the_asked_for_time(mapper: Path) -> None:
    with running_program(mapper) as process:
        busy = threads(process.pid)[1]
        begin = clock_ns(busy)
        done = inject(process.pid, {"tids": (busy,), "cpu_s": (0.05, 0.06)}, dry_run=True, watch_s=0)
        assert done.injection.bits
        assert clock_ns(busy) - begin > 40_000_000
        asleep = inject(process.pid, {"limit_s": 0.5})
        assert asleep.injection.status == "not_reached"
        assert "processor time" in asleep.injection.reason


def test_a_process_that_dies_of_the_fault_is_told_with_its_signal(mapper: Path) -> None:
    ends: Counter[str] = Counter()
    for seed in range(12):
        with running_program(mapper) as process:
            done = inject(process.pid, {"symbol": INSERT, "step": 2}, seed, model="opcode", watch_s=0.3)
            ends[done.aftermath.result] += 1
            if done.aftermath.result == "killed":
                assert done.aftermath.signal in ("SIGSEGV", "SIGILL", "SIGBUS", "SIGFPE", "SIGTRAP")
                assert done.aftermath.after_s is not None
            else:
                assert lives_untraced(process)
    assert ends["killed"] > 0
    assert ends["lives"] > 0


def test_the_code_is_as_it_was_after_an_opcode_fault(mapper: Path) -> None:
    with running_program(mapper) as process:
        with admit(process.pid) as held:
            entry, _ = function_at(process.pid, held.maps(), INSERT)
            before = held.read_memory(entry, 64)
        inject(process.pid, {"symbol": INSERT, "step": 3}, 1, model="opcode", watch_s=0.0)
        if process.poll() is None:
            with admit(process.pid) as held:
                assert held.read_memory(entry, 64) == before


def test_stuck_bits_are_held(mapper: Path) -> None:
    stuck: dict[str, Any] = {"model": "stuck_at", "stuck_value": 1, "stuck_instructions": 15}
    with running_program(mapper) as process:
        aim = {"symbol": INSERT, "step": 20}
        done = inject(process.pid, aim, 4, operand="source", register_class="vector", **stuck)
        assert done.injection.held_instructions == 15
        assert done.injection.model == "stuck_at"
        after = int(done.injection.after, 16)
        assert all(after >> bit & 1 for bit in done.injection.bits)


def test_the_drawn_call_is_the_one_that_is_struck(mapper: Path) -> None:
    """The argument of a thread's n-th call tells which call it was."""
    with running_program(mapper) as process:
        busy = threads(process.pid)[1]
        with admit(process.pid) as held:
            (data,) = [one for one in _symbols(mapper) if one[0].endswith("rounds")]
            base = min(one.start for one in module_code(held.maps(), "mapper"))
            text = next(one for one in module_code(held.maps(), "mapper"))
            rounds = base - text.offset + data[1]

            def round_now() -> int:
                return int.from_bytes(held.read_memory(rounds, 8), "little")

            before = round_now()
            inject(
                process.pid, {"symbol": INSERT, "step": 0, "call": (20, 20), "tids": (busy,)}, dry_run=True
            )
            assert round_now() - before >= 18


def _symbols(program: Path) -> list[tuple[str, int]]:
    command: list[str | Path] = ["/usr/bin/env", "nm", "-C", program]
    listed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    rows = [line.split() for line in listed.splitlines()]
    return [(row[2], int(row[0], 16)) for row in rows if len(row) == 3 and row[1] in "BbDd"]


KILLS = int(os.environ.get("ZENFI_KILLS", "40"))
MOST_MS = 25


def _strike_for_ever(pid: int) -> None:
    models: list[dict[str, Any]] = [{}, {"operand": "destination"}, {"model": "memory"}]
    busy = threads(pid)[1]
    for seed in range(10**6):
        aims: list[dict[str, Any]] = [
            {"symbol": INSERT},
            {"tids": (busy,)},
            {"module": "mapper", "tids": (busy,)},
        ]
        inject(pid, aims[seed % 3], seed, dry_run=True, watch_s=0, **models[seed % 2])


@pytest.mark.soak
def test_whoever_is_struck_lives_on_when_the_injector_is_killed_at_any_moment(mapper: Path) -> None:
    """The program has no handler for traps: with a single step under way, it would die of it."""
    moments = generator(0, "kills")
    with running_program(mapper) as process:
        for _ in range(KILLS):
            injector = os.fork()
            if not injector:
                try:
                    _strike_for_ever(process.pid)
                finally:
                    os._exit(1)
            while tracer_of(process.pid) != injector:
                assert process.poll() is None
                assert os.waitpid(injector, os.WNOHANG) == (0, 0)
            time.sleep(float(moments.random()) * MOST_MS / 1000)
            os.kill(injector, signal.SIGKILL)
            os.waitpid(injector, 0)
            assert lives_untraced(process)


CORRUPT = b"\x0f\x0b"  # ud2


def test_true_code_is_put_back_when_the_injector_is_killed_meanwhile(mapper: Path) -> None:
    with running_program(mapper) as process:
        with admit(process.pid) as held:
            entry, _ = function_at(process.pid, held.maps(), "main")
            before = held.read_memory(entry, 8)
        injector = os.fork()
        if not injector:
            with RestoredProcess(held._expected) as one, one.changed_code(entry, CORRUPT, before[:2]):
                os.kill(os.getpid(), signal.SIGKILL)
        os.waitpid(injector, 0)
        deadline = time.monotonic() + 30
        with admit(process.pid) as held:
            while held.read_memory(entry, 8) != before:
                assert time.monotonic() < deadline


def test_threads_that_are_being_made_are_waited_for(mapper: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    signals = iter([None, None, notice_for([os.getpid()])])
    monkeypatch.setattr(injection, "notice_for", lambda _: next(signals))
    with running_program(mapper) as process:
        assert inject(process.pid, {"symbol": INSERT}, dry_run=True).injection.instruction
