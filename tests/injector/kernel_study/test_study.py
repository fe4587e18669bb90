"""Copies of a kernel are struck at every place of its call, whatever others do to them meanwhile."""

import os
import signal
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path

import pytest
from scipy.stats import chisquare

from injector.faults.eligibility import is_eligible
from injector.isa.host import decode
from injector.kernel_study.results import SamplePoint, StudyRun
from injector.kernel_study.study import LOST, SubjectInjector, subject_injector
from injector.kernel_study.subject import Subject
from injector.tracing.process import Process, ProcessIdentity
from services.kernels import KERNELS
from services.models.faults.specification import FaultSpec
from tests.conftest import descendants, wait_until
from tests.injector.programs import state
from tests.injector.small_process import in_small_process

pytestmark = pytest.mark.usefixtures("may_inject")

FAULT = FaultSpec(target="pid", scope="thread")
DRAWS, PARTS = 2000, 50


@contextmanager
def controller() -> Iterator[SubjectInjector]:
    """An injector on copies of the controller; for a process of its own."""
    subject = Subject(KERNELS["pid"])
    pid, go = subject.fork()
    with subject_injector("pid", subject, pid, go) as one:
        yield one
    os.close(go)


def struck(injector: SubjectInjector, leg: list[SamplePoint]) -> dict[int, StudyRun]:
    return dict(injector.run(leg, FAULT, 8))


def told(run: StudyRun) -> tuple[str, ...]:
    """What came of it; values there can be the number of a thread."""
    return run.result, run.cause, run.injection.status, run.injection.instruction


def test_each_eligible_instruction_is_drawn_as_often_as_it_is_executed(tmp_path: Path) -> None:
    """Against the call in single steps, in fiftieths in the order of addresses."""
    in_small_process(draws_are_as_steps_count, tmp_path)


def draws_are_as_steps_count(_folder: Path) -> None:
    with controller() as injector:
        length, points = injector.draw(FAULT, 1, range(DRAWS))
        assert [point.index for point in points] != sorted(point.index for point in points)
        drawn = Counter(point.address for point in points)
        passes = Counter(address for address, _ in groupby(stepped(injector)))
        assert drawn.total() == DRAWS
        assert set(drawn) <= set(passes)
        assert all(1 <= point.hit <= passes[point.address] for point in points)
        assert length.all is not None
        assert length.eligible <= length.scope <= length.all
        with Process(ProcessIdentity.of(injector.root.pid)) as process:
            eligible = {
                address: passes[address]
                for address in sorted(passes)
                if is_eligible(FAULT, decode(process.read_code(address), address))
            }
        assert sum(eligible.values()) == length.eligible
        often, expected, at = [0], [0.0], 0
        for address, count in eligible.items():
            often[-1] += drawn[address]
            expected[-1] += DRAWS * count / length.eligible
            at += count
            if expected[-1] >= DRAWS / PARTS:
                often.append(0)
                expected.append(0.0)
        often[-2:], expected[-2:] = [sum(often[-2:])], [sum(expected[-2:])]
        assert len(often) > 20
        assert chisquare(often, expected).pvalue > 0.01


@pytest.mark.soak
def test_the_same_numbers_draw_the_same_whatever_else_is_drawn(tmp_path: Path) -> None:
    in_small_process(numbers_draw_the_same, tmp_path)


def numbers_draw_the_same(_folder: Path) -> None:
    with controller() as injector:
        _, every = injector.draw(FAULT, 3, range(12))
        _, some = injector.draw(FAULT, 3, [9, 4])
        assert sorted(point.index for point in some) == [4, 9]
        assert [point for point in every if point.index in (4, 9)] == some
        _, others = injector.draw(FAULT, 4, range(12))
        assert {point.at for point in others} != {point.at for point in every}


@pytest.mark.soak
def test_what_is_struck_at_a_place_depends_on_nothing_else(tmp_path: Path) -> None:
    in_small_process(places_depend_on_nothing_else, tmp_path)


def places_depend_on_nothing_else(_folder: Path) -> None:
    with controller() as injector:
        _, leg = injector.draw(FAULT, 2, range(40))
        together = struck(injector, leg)
        assert sorted(together) == list(range(40))
        for point in leg[::5]:
            (alone,) = struck(injector, [point]).values()
            assert told(alone) == told(together[point.index])


@pytest.mark.soak
@pytest.mark.parametrize(("number", "after"), [(signal.SIGKILL, 1), (signal.SIGSTOP, 1), (signal.SIGKILL, 2)])
def test_a_sample_that_is_lost_is_counted_and_the_others_are_made(
    tmp_path: Path, number: signal.Signals, after: int
) -> None:
    """Lost where the next copy is to be made, or on the way there."""
    in_small_process(others_are_made, tmp_path, str(int(number)), str(after))


def others_are_made(_folder: Path, signal_number: str, place: str) -> None:
    number, after = int(signal_number), int(place)
    with controller() as injector:
        _, drawn = injector.draw(FAULT, 5, range(4))
        places = [drawn[0], drawn[1], drawn[1], drawn[2], drawn[3]]
        leg = [point.model_copy(update={"index": at}) for at, point in enumerate(places)]
        alone = struck(injector, leg)
        others = set(descendants(os.getpid()))
        found = {}
        for index, run in injector.run(leg, FAULT, 8):
            found[index] = run
            if index == after:  # who goes through the call stands at the place
                (walker,) = set(descendants(os.getpid())) - others
                os.kill(walker, number)
                if number == signal.SIGKILL:
                    wait_until(lambda pid=walker: state(pid) in "Z")  # type: ignore[misc]
        lost = found.pop(after + 1)
        assert (lost.result, lost.cause) == ("not_injected", LOST.reason)
        assert found == {index: run for index, run in alone.items() if index != after + 1}
        assert set(descendants(os.getpid())) == others


def stepped(injector: SubjectInjector) -> list[int]:
    """The call in single steps; the mark comes before the last that is seen."""
    tracees, forks = injector.tracees, injector.forks
    copy = forks.copy(injector.root)
    found = tracees.trace(copy, 10**6)[:-1]
    forks.end(copy)
    return found
