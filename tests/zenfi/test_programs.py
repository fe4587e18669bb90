"""Studies of programs from Python: kept in a file, gone on with, replayed."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.errors import BadSpecError
from deploy.kernel_study.file import kept_study
from tests.conftest import PATIENCE_S, descendants, wait_until
from zenfi import programs

COMMAND = ["sh", "-c", "printf %s hello"]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "runs.jsonl"


def test_a_study_is_kept_gone_on_with_and_replayed(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    short = programs.run(COMMAND, 12, seed=4, slots=1, output=file, progress=False)
    monkeypatch.setenv("PATH", f"{os.environ['PATH']}:/another/shell")
    whole = programs.run(COMMAND, 24, seed=4, slots=2, output=file, progress=False)
    assert whole.runs[:12] == short.runs
    assert programs.run(COMMAND, 24, seed=4, slots=2, progress=False).runs == whole.runs
    assert sum(one.count for one in whole.summary.shares.values()) == whole.summary.injected == 24
    length = whole.summary.length
    assert length.all is not None
    assert 10_000 < length.eligible <= length.scope == length.all
    assert sum(count for _, count, _ in whole.by("register")) == 24
    replayed = programs.replay(file, slots=2)
    assert len(replayed) == 24
    assert all(one.same for one in replayed)
    (single,) = programs.replay(file, [7], slots=1)
    assert single.was == single.now == whole.runs[7]


def test_a_replay_that_differs_is_told(file: Path) -> None:
    programs.run(COMMAND, 4, seed=1, slots=1, output=file, progress=False)
    lines = file.read_text().splitlines()
    bits = next(line for line in lines if '"bits":[' in line)
    number = bits.partition('"bits":[')[2].partition("]")[0]
    file.write_text(file.read_text().replace(f'"bits":[{number}]', '"bits":[99]', 1))
    assert [one.same for one in programs.replay(file, slots=1)].count(False) == 1


def test_what_is_killed_loses_nothing_and_leaves_nothing(file: Path) -> None:
    program = f"from zenfi import programs; programs.run({COMMAND!r}, 60, output={str(file)!r})"
    process = subprocess.Popen([sys.executable, "-c", program], stderr=subprocess.DEVNULL)
    wait_until(lambda: file.exists() and file.read_bytes().count(b"\n") > 20, PATIENCE_S)
    started = descendants(process.pid)
    process.send_signal(signal.SIGKILL)
    process.wait()
    wait_until(lambda: not [one for one in started if Path(f"/proc/{one}/exe").exists()], PATIENCE_S)
    _, kept = kept_study(file)
    assert len(kept) >= 19
    whole = programs.run(COMMAND, 60, output=file, progress=False)
    assert [whole.runs[index] for index in kept] == list(kept.values())
    assert whole.runs == programs.run(COMMAND, 60, progress=False).runs


@pytest.mark.parametrize(
    ("command", "more", "problem"),
    [
        (["no-such-program"], {}, "no-such-program: no such program"),
        ([], {}, "no command"),
        (["true"], {"stdin": "/nothing/here"}, "/nothing/here: no such file"),
        (["true"], {"compare": ["/var/result"]}, "expected a file in the run's own folder"),
        (["true"], {"ignore": ["stdin"]}, "ignore.0: Input should be .stdout. or .stderr."),
        (["true"], {"address": 16}, "address: needs its module"),
        (["true"], {"line": "main.c:0"}, "expected FILE:LINE"),
    ],
)
def test_what_cannot_be_run_is_refused(command: list[str], more: dict[str, object], problem: str) -> None:
    with pytest.raises(BadSpecError, match=problem):
        programs.program(command, **more)  # type: ignore[arg-type]


def test_a_fault_that_has_nothing_to_strike_or_is_of_a_flight_is_refused() -> None:
    with pytest.raises(BadSpecError, match="struck once, at level instruction"):
        programs.run(["true"], 1, fault="recurrence=intermittent,probability=0.1,opcodes=add", progress=False)
    with pytest.raises(BadSpecError, match="not the same in each run"):
        programs.run(["date", "+%N"], 1, progress=False)


def test_a_file_of_something_else_is_refused(file: Path) -> None:
    programs.run(COMMAND, 1, slots=1, output=file, progress=False)
    with pytest.raises(BadSpecError, match="another fault, seed or command"):
        programs.run(COMMAND, 2, seed=1, output=file, progress=False)
    with pytest.raises(BadSpecError, match="there is no run 5"):
        programs.replay(file, [5])
    file.write_text("{}")
    with pytest.raises(BadSpecError, match="no file of a study of a program"):
        programs.replay(file)
