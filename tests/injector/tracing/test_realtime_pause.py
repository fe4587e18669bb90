"""In a pause nobody else holds us up, and nothing is done that could have been done before."""

import os

import pytest

from injector.faults.apply import apply_fault
from injector.faults.stopped_thread import registers_of
from injector.tracing import ptrace
from injector.tracing.process import threads, tracer_of
from injector.tracing.realtime_pause import RealtimePause
from injector.tracing.tracees import TraceeGroup
from services.runtime.rng import generator
from tests.injector.faults.test_apply import MOVE, VALUE, fault, held, step_to
from tests.injector.programs import assemble, running, state

pytestmark = pytest.mark.usefixtures("may_inject")


def real_time_is_granted() -> bool:
    pause = RealtimePause()
    pause.begin()
    try:
        return os.sched_getscheduler(0) == os.SCHED_FIFO
    finally:
        pause.end()


def test_the_injector_has_real_time_priority_in_a_pause_and_never_after_it() -> None:
    usual = os.SCHED_OTHER, os.nice(0)  # also after the pauses of tests before
    granted = real_time_is_granted()
    with running(assemble(), threads=2) as target:
        target.start()
        with TraceeGroup() as tracees:
            tracees.seize([target.pid])
            assert os.sched_getscheduler(0) == usual[0]
            tracees.stop_all()
            assert os.sched_getscheduler(0) == (os.SCHED_FIFO if granted else usual[0])
            tracees.resume_all()
            assert (os.sched_getscheduler(0), os.nice(0)) == usual
            tracees.stop_all()
        assert (os.sched_getscheduler(0), os.nice(0)) == usual
        assert tracees.pause_us > 0


def test_without_the_right_to_real_time_priority_a_pause_is_as_good(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with running(assemble(), threads=2) as target, TraceeGroup() as tracees:
        target.start()
        tracees.seize([target.pid])
        tracees.stop_all()
        assert {state(tid) for tid in threads(target.pid)} == {"t"}
        tracees.resume_all()
        assert tracees.pause_us > 0
        target.wait_for_progress(1)


def test_a_wait_for_one_thread_has_an_end_in_a_pause() -> None:
    with running(assemble()) as target, TraceeGroup() as tracees:
        target.start()
        tracees.seize([target.pid])
        pause = RealtimePause()
        pause.begin()
        try:
            assert ptrace.await_report_or_signal(target.pid) is None  # it runs on
        finally:
            pause.end()
        target.wait_for_progress(1)


@pytest.mark.parametrize("operand", ["source", "destination"])
def test_everybody_goes_on_before_it_is_told_what_was_struck(operand: str) -> None:
    with running(assemble(after=[MOVE]), threads=2) as target:
        target.start({"rcx": VALUE})
        with held(target) as (tracees, thread, process):
            target.go()
            step_to("mov rbx,rcx", tracees, thread, process)
            spec, draw = fault(operand, "gpr"), generator(1, "test")  # type: ignore[arg-type]
            found = apply_fault(
                tracees, thread, process, spec, draw, stop=tracees.stop_all, go=tracees.detach_all
            )
            assert not tracees.threads
            assert {tracer_of(tid) for tid in threads(target.pid)} == {0}
            target.finish()
        assert found is not None
        assert found.read_back == found.after == found.before ^ sum(1 << bit for bit in found.bits)


@pytest.mark.parametrize("operand", ["source", "destination"])
def test_what_is_struck_is_drawn_before_the_others_are_stopped(operand: str) -> None:
    """They are stopped once, and at that moment nothing has been changed or executed."""
    found_there: list[tuple[int, int]] = []
    draw = generator(1, "test")
    with running(assemble(after=[MOVE])) as target:
        target.start({"rcx": VALUE})
        with held(target) as (tracees, thread, process):
            target.go()
            step_to("mov rbx,rcx", tracees, thread, process)

            def stop() -> None:
                assert repr(draw.bit_generator.state) != untouched
                registers = registers_of(thread)
                found_there.append((registers.program_counter, registers.get("rcx")))

            place, untouched = registers_of(thread).program_counter, repr(draw.bit_generator.state)
            found = apply_fault(tracees, thread, process, fault(operand, "gpr"), draw, stop=stop)  # type: ignore[arg-type]
        target.finish()
        assert found is not None
        assert found.status == "injected"
        assert found_there == [(place, VALUE)]
