"""A process that ends at whatever moment of an injection is told of in one line."""

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from injector.faults.code_restorer import RestoredProcess
from injector.tracing.process import ProcessIdentity, VanishedError
from tests.conftest import wait_until
from tests.dashboard.command import Answer, zenfi
from tests.injector.cpp_program import mapper, running_program
from tests.injector.programs import state

pytestmark = pytest.mark.usefixtures("may_inject")

__all__ = ["mapper"]

OURS = str(Path(__file__).parents[3])
AIMS: list[tuple[object, ...]] = [
    ("--symbol", "grid::insert(double, int)", "--step", "3", "--dry-run"),
    ("--fault", "model=opcode", "--symbol", "lengthy", "--cpu-s", "0"),
    ("--symbol", "lengthy", "--cpu-s", "0.001", "--dry-run"),
]


def ended_at(program: Path, aim: tuple[object, ...], moment: int) -> tuple[Answer, int]:
    """The answer about a process that is killed at that call of a function of ours; how many there were."""
    calls = 0
    with running_program(program) as process:

        def count(frame: FrameType, event: str, _: Any) -> None:
            nonlocal calls
            if event in ("call", "return") and frame.f_code.co_filename.startswith(OURS):
                calls += 1
                if calls == moment:
                    with suppress(ProcessLookupError):  # it died of the fault, and whoever traced it knows
                        os.kill(process.pid, signal.SIGKILL)
                        wait_until(lambda: state(process.pid) in "Zt")

        sys.setprofile(count)
        try:
            answer = zenfi("inject", "--pid", process.pid, *aim, "--limit-s", "2", "--watch-s", "0")
        finally:
            sys.setprofile(None)
        said = answer.stdout + answer.stderr
        if answer.stdout.startswith("failed"):
            assert answer.returncode == 1
            assert "the process ended before the fault" in said, said
        if answer.returncode == 2:
            assert f"process {process.pid}" in said
            assert said.count("\n") == 1
        assert answer.returncode in (0, 1, 2), said
    return answer, calls


@pytest.mark.parametrize("aim", AIMS)
def test_whatever_the_moment_one_line_tells(mapper: Path, aim: tuple[object, ...]) -> None:
    _, calls = ended_at(mapper, aim, 0)
    answers = [ended_at(mapper, aim, round(calls * part / 8)) for part in range(1, 8)]
    assert {answer.returncode for answer, _ in answers} >= {1}


def test_one_that_ended_before_its_helper_process_was_started_is_gone() -> None:
    with subprocess.Popen(["/bin/sleep", "1000"]) as process:
        identity = ProcessIdentity.of(process.pid)
        process.kill()
    with pytest.raises(VanishedError):
        RestoredProcess(identity)


@pytest.mark.soak
@pytest.mark.parametrize("aim", AIMS)
def test_at_hundreds_of_moments_one_line_tells(mapper: Path, aim: tuple[object, ...]) -> None:
    _, calls = ended_at(mapper, aim, 0)
    for moment in [*range(1, 600, 7), *range(600, calls, max(1, calls // 200))]:
        ended_at(mapper, aim, moment)
