"""What ``python3 launch.py`` runs side by side: all ends, all is shown, the first failure counts."""

import signal
import subprocess
import sys
from pathlib import Path

import launch
from tests.conftest import wait_until
from tests.test_names import ROOT

RUN = "import launch; raise SystemExit(launch.run({commands!r}))"


def command(code: str) -> list[str]:
    return ["python", "-c", code]


def script(*codes: str) -> list[str]:
    return [sys.executable, "-c", RUN.format(commands=[command(code) for code in codes])]


def test_every_command_ends_and_is_shown_and_the_first_failure_is_the_status() -> None:
    late = "import sys, time; time.sleep(1); print('late'); sys.exit(3)"
    done = subprocess.run(
        script(late, "print('fine')", "print('tests'); raise SystemExit(5)"),
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 3
    assert done.stdout.startswith("tests\n")
    assert "failed with 3\nlate\n" in done.stdout
    assert "passed\nfine\n" in done.stdout


def test_commands_end_with_it(tmp_path: Path) -> None:
    begun = [tmp_path / "one", tmp_path / "two"]
    codes = [f"import pathlib, time; pathlib.Path({str(one)!r}).touch(); time.sleep(600)" for one in begun]
    with subprocess.Popen(script(*codes), cwd=ROOT, stderr=subprocess.DEVNULL) as running:
        wait_until(lambda: all(one.exists() for one in begun))
        running.send_signal(signal.SIGINT)
        assert running.wait(60) != 0


def test_each_file_of_the_gate_is_in_one_part() -> None:
    parts = [command for command in launch.commands("test", []) if command[0] == "pytest"]
    assert parts == [["pytest", "-m", "not soak", *part] for part in launch.PARTS]

    def runs(part: list[str], file: Path) -> bool:
        left_out = [ROOT / one.removeprefix("--ignore=") for one in part if one.startswith("--ignore=")]
        chosen = [ROOT / one for one in part if not one.startswith("--")] or [ROOT]
        assert all(folder.is_dir() for folder in (*chosen, *left_out))
        return any(map(file.is_relative_to, chosen)) and not any(map(file.is_relative_to, left_out))

    for file in (ROOT / "tests").rglob("test_*.py"):
        assert [runs(part, file) for part in launch.PARTS].count(True) == 1, file


def test_tests_that_are_asked_for_run_once() -> None:
    runs = [command for command in launch.commands("test", ["-k", "pid"]) if command[0] == "pytest"]
    assert runs == [["pytest", "-m", "not soak", "-k", "pid"]]


def test_an_unknown_job_is_told_which_there_are() -> None:
    done = subprocess.run(
        [sys.executable, "launch.py", "sing"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (
        2,
        "usage: python3 launch.py demo|test|unit|soak|mutants|docs\n",
    )
