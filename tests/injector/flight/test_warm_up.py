"""The injector warms up on a fork of its own, which somebody may kill."""

import os
import signal
import time
from contextlib import suppress
from pathlib import Path

import pytest

from injector.flight.warm_up import warm_up_on_a_fork
from services.models.faults.specification import FaultSpec
from tests.injector.small_process import in_small_process

pytestmark = pytest.mark.usefixtures("may_inject")


def test_a_fork_that_somebody_kills_is_no_matter(tmp_path: Path) -> None:
    in_small_process(killed_at_many_moments, tmp_path)


def killed_at_many_moments(_: Path) -> None:
    own, hits = os.getpid(), 0
    children = Path(f"/proc/{own}/task/{own}/children")
    for number in range(12):
        killer = os.fork()
        if not killer:
            os._exit(kill_soon(children, 0.002 + 0.0015 * number))
        warm_up_on_a_fork(FaultSpec(target="pid"))
        hits += os.waitstatus_to_exitcode(os.waitpid(killer, 0)[1])
        assert not children.read_text(), "a fork was left"
    assert hits, "no fork was killed: nothing was tried"


def kill_soon(children: Path, after_s: float) -> int:
    """Kill those of the processes that are not us; how many there were."""
    time.sleep(after_s)
    others = {*map(int, children.read_text().split())} - {os.getpid()}
    for pid in others:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    return len(others)
