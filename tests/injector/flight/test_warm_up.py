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
    own = os.getpid()
    children = Path(f"/proc/{own}/task/{own}/children")
    for number in range(12):
        killer = os.fork()
        if not killer:
            time.sleep(0.002 + 0.0015 * number)
            for pid in {*map(int, children.read_text().split())} - {os.getpid()}:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            os._exit(0)
        warm_up_on_a_fork(FaultSpec(target="pid"))
        os.waitpid(killer, 0)
