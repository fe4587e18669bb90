"""The commands of docs/own_stack.md and docs/ros2.md, as they stand there."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.dashboard.command import refusal
from tests.fixtures.own_stacks import EXAMPLE

DOCS = EXAMPLE.parent
PATIENCE_S = 300


def commands(page: str, heading: str) -> list[str]:
    """What stands behind a dollar sign under a heading."""
    section = (DOCS / page).read_text().split(f"{heading}\n", 1)[1].split("\n## ", 1)[0]
    return [line.split("   #")[0] for line in re.findall(r"^\$ (.*)$", section, re.MULTILINE)]


def run(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return subprocess.run(  # noqa: S602 - as somebody types it
        command,
        shell=True,
        cwd=folder,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_S,
    )


@pytest.mark.soak
@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler here")
def test_the_example_flies_is_struck_and_replays(tmp_path: Path) -> None:
    shutil.copytree(EXAMPLE, tmp_path, dirs_exist_ok=True)
    build, fly, strike, replay = commands("own_stack.md", "## Control in C++, struck")
    for command in (build, strike):
        done = run(command, tmp_path)
        assert done.returncode == 0, done.stderr
    golden = json.loads(run(fly, tmp_path).stdout)
    struck = json.loads((tmp_path / "struck.json").read_text())
    assert golden["result"] == "success"
    assert struck["golden"]["digest"] == golden["digest"]
    assert struck["injection"]["status"] == "injected"
    assert struck["injection"]["node"] == "control"
    assert struck["injection"]["instruction"]
    assert "replayed" in run(replay, tmp_path).stdout


def test_the_file_in_the_page_is_that_of_the_example() -> None:
    page = (DOCS / "own_stack.md").read_text().split("```toml\n", 1)[1].split("```", 1)[0]
    shown = [line.split("#")[0].strip() for line in page.splitlines()]
    for line in (EXAMPLE / "pursuit.toml").read_text().splitlines():
        assert line.strip() in shown


def test_the_interface_package_is_written_once(tmp_path: Path) -> None:
    package, _ = commands("ros2.md", "# ROS 2 over Zenoh")
    assert run(package, tmp_path).stdout.strip() == "src/zenfi_msgs"
    assert (tmp_path / "src" / "zenfi_msgs" / "package.xml").exists()
    again = run(package, tmp_path)
    assert again.returncode == 2
    assert again.stderr == "zenfi: src/zenfi_msgs: File exists\n"


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("stages = 3", "stages"),
        ('[stages.control]\ncommand = ["./nothing"]\n', "No such file or directory"),
        (
            '[stages.control]\ncommand = ["no-such-program"]\n',
            "there is no program 'no-such-program' in PATH",
        ),
        ('[stages.control]\ncommand = ["/etc/hostname"]\n', "is no program that can be run"),
        ('[stages.control]\ncommand = ["true"]\n', "latency"),
        ('[stages.sim]\ncommand = ["true"]\nlatency = { mean_ms = 1 }\n', "stages.sim"),
    ],
)
def test_a_bad_stack_file_is_one_line(tmp_path: Path, content: str, told: str) -> None:
    file = tmp_path / "bad.toml"
    file.write_text(f'name = "bad"\n{content}')
    assert told in refusal("fly", "--stack", file)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--ros-domain", "7", "--ros-endpoint", "tcp/127.0.0.1:1"], "no Zenoh router at tcp/127.0.0.1:1"),
        (["--ros-domain", "999"], "domain: Input should be less than or equal to 232"),
    ],
)
def test_a_domain_that_cannot_be_joined_is_one_line(options: list[str], told: str) -> None:
    assert told in refusal("fly", *options)
