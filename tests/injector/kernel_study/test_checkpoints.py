"""A copy that goes through a call stops at each drawn instruction, as single steps number them."""

from itertools import groupby, pairwise
from pathlib import Path

import pytest

from injector.faults.call_profile import CallProfile
from injector.kernel_study.checkpoints import CheckpointError, CheckpointRun
from injector.kernel_study.results import SamplePoint
from injector.kernel_study.subject import MARK
from injector.tracing import ptrace
from injector.tracing.compiled_functions import CompiledFunctions
from injector.tracing.process import Process, ProcessIdentity
from services.models.faults.specification import FaultSpec
from tests.injector.block_profile.test_counted_call import CALLS
from tests.injector.forked_calls import Standing, standing
from tests.injector.small_process import in_small_process

pytestmark = pytest.mark.usefixtures("may_inject")

FAULT = FaultSpec(target="pid", scope="thread")
POINTS = 12
TWICE = 10**6


def run_of(one: Standing) -> CheckpointRun:
    copy = one.forks.copy(one.root)
    with Process(ProcessIdentity.of(copy.pid)) as process:
        leaders = CallProfile(copy, process, FAULT, MARK, CompiledFunctions()).counts.leaders
    one.forks.end(copy)
    return CheckpointRun(one.tracees, one.forks, one.root, MARK, FAULT, leaders)


def executed(one: Standing) -> list[int]:
    """The call's instructions, a repeated one once; the mark comes before the last that is seen."""
    return [address for address, _ in groupby(one.trace())][:-1]


def points_of(trace: list[int], indices: list[int]) -> list[SamplePoint]:
    return [SamplePoint(index=at, address=trace[at], hit=trace[: at + 1].count(trace[at])) for at in indices]


IN_THE_GATE = {"a jump over many calls"}


@pytest.mark.parametrize(
    "name", [pytest.param(one, marks=[pytest.mark.soak] * (one not in IN_THE_GATE)) for one in CALLS]
)
def test_each_point_is_met_where_single_steps_number_it(tmp_path: Path, name: str) -> None:
    in_small_process(points_are_those_of_steps, tmp_path, CALLS[name])


def points_are_those_of_steps(tmp_path: Path, kernel: str) -> None:
    def number(point: SamplePoint) -> int:
        return point.index if point.index < TWICE else 1

    with standing(tmp_path, kernel) as one:
        trace, run = executed(one), run_of(one)
        # The first and the last, neighbours, one of them twice, and some in between.
        indices = sorted(
            {0, 1, 2, len(trace) - 2, len(trace) - 1, *range(3, len(trace), len(trace) // POINTS)}
        )
        points = [*points_of(trace, indices), SamplePoint(index=TWICE, address=trace[1], hit=1)]
        leg = run.in_order(list(reversed(points)))
        assert [point.at for point in leg] == [point.at for point in sorted(points, key=number)]
        for point, thread, _ in run.visit(leg):
            assert ptrace.program_counter(thread.tid) == point.address
            copy = one.forks.copy(thread)
            left = trace[number(point) :]
            rest = [address for address, _ in groupby(one.tracees.trace(copy, 10**6))]
            one.forks.end(copy)
            # A copy that is made just before the mark sends it to who was copied, and goes on.
            assert rest[: len(left)] == left


def test_a_repeated_instruction_is_gone_through_as_one(tmp_path: Path) -> None:
    in_small_process(repetitions_count_once, tmp_path, CALLS["loops of one instruction"])


def repetitions_count_once(tmp_path: Path, kernel: str) -> None:
    """A way that begins at a repeated instruction does not take its repetitions for passes."""
    with standing(tmp_path, kernel) as one:
        run = run_of(one)
        steps = one.trace()[:-1]
        repeated = next(at for at, other in pairwise(steps) if at == other and is_rep(one, at))
        after = steps[len(steps) - 1 - steps[::-1].index(repeated) + 1]
        passes = [address for address, _ in groupby(steps)].count(repeated)
        leg = run.in_order(
            [SamplePoint(index=hit, address=repeated, hit=hit) for hit in range(1, passes + 1)]
            + [SamplePoint(index=0, address=after, hit=1)]
        )
        met = [
            point.at
            for point, thread, _ in run.visit(leg)
            if ptrace.program_counter(thread.tid) == point.address
        ]
        assert met == [point.at for point in leg]


def is_rep(one: Standing, address: int) -> bool:
    with Process(ProcessIdentity.of(one.root.pid)) as process:
        return process.read_memory(address, 1) in (b"\xf2", b"\xf3")


def test_a_pass_that_never_comes_is_told(tmp_path: Path) -> None:
    in_small_process(a_pass_too_many, tmp_path, CALLS["recursion"])


def a_pass_too_many(tmp_path: Path, kernel: str) -> None:
    with standing(tmp_path, kernel) as one:
        trace, run = executed(one), run_of(one)
        (point,) = points_of(trace, [len(trace) // 2])
        missed = point.model_copy(update={"hit": trace.count(point.address) + 1})
        with pytest.raises(CheckpointError, match="ended before"):
            run.in_order([point, missed])
