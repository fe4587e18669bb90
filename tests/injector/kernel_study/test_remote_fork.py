"""A copy that is made from outside stands where its origin stands, and neither notices."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from injector.faults.stopped_thread import registers_of
from injector.kernel_study.remote_fork import RemoteForkError
from injector.tracing import ptrace
from injector.tracing.ptrace import StopReport
from injector.tracing.tracee import Tracee
from tests.conftest import alive, wait_until
from tests.injector.faults.test_drawn_sites import KERNELS
from tests.injector.forked_calls import standing

pytestmark = pytest.mark.usefixtures("may_inject")


def test_copies_from_anywhere_in_the_call_come_to_the_same_result(tmp_path: Path) -> None:
    with standing(tmp_path, KERNELS["floats"]) as one:
        trace = one.trace()
        walker = one.forks.copy(one.root)
        results = []
        for at in range(0, len(trace) - 1, 97):
            assert registers_of(walker).program_counter == trace[at]
            copy = one.forks.copy(walker)
            assert registers_of(copy).program_counter == trace[at]
            assert registers_of(copy).get("rsp") == registers_of(walker).get("rsp")
            assert registers_of(copy).get("xmm0") == registers_of(walker).get("xmm0")
            results.append(one.result(copy))
            for _ in range(min(97, len(trace) - 1 - at)):
                assert one.tracees.step(walker) == "stepped"
        assert set(results) == {one.result(one.forks.copy(one.root))}
        assert len(results) > 3


def test_what_happens_to_a_copy_does_not_happen_to_its_origin(tmp_path: Path) -> None:
    with standing(tmp_path, KERNELS["integers"]) as one:
        right = one.result(one.forks.copy(one.root))
        copy = one.forks.copy(one.root)
        registers = registers_of(copy)
        registers.put("rsp", 8)
        registers.commit()
        assert one.result(copy) is None
        assert one.result(one.forks.copy(one.root)) == right


def reported(thread: Tracee) -> StopReport:
    """What a thread that goes on has to report first."""
    ptrace.resume(thread.tid)
    return ptrace.await_report(thread.tid)


def test_a_copy_is_made_where_the_mark_of_the_calls_end_is_under_way(tmp_path: Path) -> None:
    with standing(tmp_path, KERNELS["integers"]) as one:
        walker = one.forks.copy(one.root)
        for _ in range(len(one.trace()) - 1):
            assert one.tracees.step(walker) == "stepped"
        results = [one.result(one.forks.copy(walker)) for _ in range(2)]
        assert results == [one.result(one.forks.copy(one.root))] * 2
        assert one.tracees.step(walker) == "ended"  # the mark is still to come


def test_signals_from_others_wait_until_the_copy_is_made(tmp_path: Path) -> None:
    with standing(tmp_path, KERNELS["integers"]) as one:
        walker = one.forks.copy(one.root)
        sent = {signal.SIGUSR1, signal.SIGURG, signal.SIGTERM, signal.SIGRTMIN}
        for number in sent:
            os.kill(walker.pid, number)
        copy = one.forks.copy(walker)
        assert {reported(walker).signal for _ in sent} == sent
        assert one.result(copy) == one.result(one.forks.copy(one.root))


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_who_is_killed_or_stopped_by_others_is_not_copied(number: signal.Signals, tmp_path: Path) -> None:
    with standing(tmp_path, KERNELS["integers"]) as one:
        walker = one.forks.copy(one.root)
        os.kill(walker.pid, number)
        with pytest.raises(RemoteForkError, match=f"process {walker.pid} was not copied"):
            one.forks.copy(walker)
        one.forks.end(walker)
        assert not alive(walker.pid)
        assert one.result(one.forks.copy(one.root)) is not None


KILLED = """
import sys, time
from pathlib import Path
from tests.injector.forked_calls import standing
with standing(Path(sys.argv[1]), "double kernel(void) { for (;;); }") as one:
    copy = one.forks.copy(one.root)
    one.tracees.resume(copy)
    print(one.root.pid, copy.pid, flush=True)
    time.sleep(600)
"""


def test_copies_that_run_for_ever_die_with_their_tracer(tmp_path: Path) -> None:
    tracer = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(tmp_path)], cwd=Path(__file__).parents[3], stdout=subprocess.PIPE
    )
    assert tracer.stdout is not None
    pids = [int(word) for word in tracer.stdout.readline().split()]
    assert all(map(alive, pids))
    tracer.kill()
    tracer.communicate()
    for pid in pids:
        wait_until(lambda pid=pid: not alive(pid))  # type: ignore[misc]
