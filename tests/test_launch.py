"""What ``python3 launch.py`` installs and runs: all ends, all is shown, the first failure counts."""

import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

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
    jobs = "demo|test|unit|soak|mutants|docs|dependencies|vulnerabilities|release"
    usage = f"usage: python3 launch.py [--locked] {jobs}, or lock\n"
    assert (done.returncode, done.stderr) == (2, usage)


def test_locked_installs_the_versions_of_the_lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, ...]] = []
    monkeypatch.setattr(launch, "ENVIRONMENT", tmp_path)
    monkeypatch.setattr(launch, "BIN", tmp_path)
    monkeypatch.setattr(launch, "LOCK", tmp_path / "lock")
    monkeypatch.setattr(launch, "pip", lambda *arguments: asked.append(arguments))
    (tmp_path / "pip").touch()
    launch.LOCK.write_text("numpy==2.0.0\n")
    launch.install(".", locked=True)
    launch.install(".", locked=True)
    assert [one[-2:] for one in asked] == [("--constraint", str(launch.LOCK))]
    launch.LOCK.write_text("numpy==2.0.1\n")
    launch.install(".", locked=True)
    assert len(asked) == 2
    launch.install(".", locked=False)
    assert "--constraint" not in asked[-1]
    assert len(asked) == 3


def test_the_lock_has_a_version_of_each_requirement() -> None:
    lines = [one for one in launch.LOCK.read_text().splitlines() if not one.startswith("#")]
    locked = {canonicalize_name(one.name): one.specifier for one in map(Requirement, lines)}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for line in (*project["dependencies"], *project["optional-dependencies"]["test"]):
        required = Requirement(line)
        (version,) = locked[canonicalize_name(required.name)]
        assert version.operator == "=="
        assert "+" not in version.version, "a build that one index has"
        assert required.specifier.contains(version.version), line
