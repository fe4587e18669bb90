"""Copies of a kernel are struck at every place of its call, whatever others do to them meanwhile."""

import faulthandler
import gc
import os
import signal
from collections.abc import Iterator

import pytest

from injector.kernel_study.checkpoints import BEGINNING, SamplePoint
from injector.kernel_study.instruction_index import InstructionIndex
from injector.kernel_study.study import LOST, StudyRun, SubjectInjector, subject_injector
from injector.kernel_study.subject import Subject
from services.kernels import KERNELS
from services.models.fault_spec import FaultSpec
from tests.conftest import descendants, wait_until
from tests.injector.programs import state

pytestmark = pytest.mark.usefixtures("may_inject")

FAULT = FaultSpec(target="pid", scope="thread")


@pytest.fixture
def injector() -> Iterator[SubjectInjector]:
    """On copies of the controller."""
    crashes_are_told = faulthandler.is_enabled()
    faulthandler.disable()  # by pytest, at length, also of copies
    try:
        subject = Subject(KERNELS["pid"])
        pid, go = subject.fork()
        with subject_injector("pid", subject, pid, go) as one:
            yield one
        os.close(go)
    finally:
        gc.unfreeze()
        gc.enable()
        if crashes_are_told:
            faulthandler.enable()


def places(*steps: int) -> list[SamplePoint]:
    return [
        SamplePoint(index=number, anchor=BEGINNING, hit=1, step=step) for number, step in enumerate(steps)
    ]


def struck(
    injector: SubjectInjector, clock: InstructionIndex, leg: list[SamplePoint]
) -> dict[int, StudyRun | None]:
    return dict(injector.run(clock, leg, FAULT, 8))


def told(run: StudyRun | None) -> tuple[str, ...]:
    """What came of it, nothing where the place was refused; values there can be the number of a thread."""
    if run is None:
        return ()
    return run.result, run.cause, run.injection.status, run.injection.instruction


@pytest.mark.soak
def test_the_last_places_of_a_call_are_struck(injector: SubjectInjector) -> None:
    """The mark of the call's end is under way to the very last one."""
    trace, whole = injector.anchor_search.begin()
    assert whole
    leg = places(*range(len(trace) - 8, len(trace)), len(trace) - 1)
    runs = struck(injector, InstructionIndex(reach=len(trace)), leg)
    assert sorted(runs) == [place.index for place in leg]
    last = [runs[index] for index in (7, 8)]
    assert [run is not None and run.injection.status for run in last] == ["injected", "injected"]
    # What is struck at a place does not depend on what else is struck in the call.
    for place in leg:
        (alone,) = struck(injector, InstructionIndex(reach=len(trace)), [place]).values()
        assert told(alone) == told(runs[place.index])


@pytest.mark.soak
@pytest.mark.parametrize(("number", "after"), [(signal.SIGKILL, 1), (signal.SIGSTOP, 1), (signal.SIGKILL, 2)])
def test_a_sample_that_is_lost_is_counted_and_the_others_are_made(
    injector: SubjectInjector, number: signal.Signals, after: int
) -> None:
    """Lost where the next copy is to be made, or on the way there."""
    clock, leg = InstructionIndex(reach=9000), places(10, 500, 500, 7000, 8000)
    alone = struck(injector, clock, leg)
    others = set(descendants(os.getpid()))
    found = {}
    runs = injector.run(clock, leg, FAULT, 8)
    for index, run in runs:
        found[index] = run
        if index == after:  # who goes through the call stands at the place
            (walker,) = set(descendants(os.getpid())) - others
            os.kill(walker, number)
            if number == signal.SIGKILL:
                wait_until(lambda pid=walker: state(pid) in "Z")  # type: ignore[misc]
    lost = found.pop(after + 1)
    assert lost is not None
    assert (lost.result, lost.cause) == ("not_injected", LOST.reason)
    assert found == {index: run for index, run in alone.items() if index != after + 1}
    assert set(descendants(os.getpid())) == others
