"""A copy that is made from outside stands where its origin stands, and neither notices."""

import subprocess
import sys
from pathlib import Path

import pytest

from injector.inject import registers_of
from tests.conftest import alive, wait_until
from tests.injector.forked_calls import standing
from tests.injector.test_sites import KERNELS

pytestmark = pytest.mark.usefixtures("may_inject")


def test_copies_from_anywhere_in_the_call_come_to_the_same_result(tmp_path: Path) -> None:
    with standing(tmp_path, KERNELS["floats"]) as one:
        trace = one.trace()
        walker = one.copies.copy(one.root)
        results = []
        for at in range(0, len(trace) - 1, 97):
            assert registers_of(walker).program_counter == trace[at]
            copy = one.copies.copy(walker)
            assert registers_of(copy).program_counter == trace[at]
            assert registers_of(copy).get("rsp") == registers_of(walker).get("rsp")
            assert registers_of(copy).get("xmm0") == registers_of(walker).get("xmm0")
            results.append(one.result(copy))
            for _ in range(min(97, len(trace) - 1 - at)):
                assert one.tracees.step(walker) == "stepped"
        assert set(results) == {one.result(one.copies.copy(one.root))}
        assert len(results) > 3


def test_what_happens_to_a_copy_does_not_happen_to_its_origin(tmp_path: Path) -> None:
    with standing(tmp_path, KERNELS["integers"]) as one:
        right = one.result(one.copies.copy(one.root))
        copy = one.copies.copy(one.root)
        registers = registers_of(copy)
        registers.put("rsp", 8)
        registers.commit()
        assert one.result(copy) is None
        assert one.result(one.copies.copy(one.root)) == right


KILLED = """
import sys, time
from pathlib import Path
from tests.injector.forked_calls import standing
with standing(Path(sys.argv[1]), "double kernel(void) { for (;;); }") as one:
    copy = one.copies.copy(one.root)
    one.tracees.resume(copy)
    print(one.root.pid, copy.pid, flush=True)
    time.sleep(600)
"""


def test_copies_that_run_for_ever_die_with_their_tracer(tmp_path: Path) -> None:
    tracer = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(tmp_path)], cwd=Path(__file__).parents[2], stdout=subprocess.PIPE
    )
    assert tracer.stdout is not None
    pids = [int(word) for word in tracer.stdout.readline().split()]
    assert all(map(alive, pids))
    tracer.kill()
    tracer.communicate()
    for pid in pids:
        wait_until(lambda pid=pid: not alive(pid))  # type: ignore[misc]
