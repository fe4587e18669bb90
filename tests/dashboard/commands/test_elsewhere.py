"""A command gives the same answer in every shell: faults strike where they struck, whoever asks."""

import json
import os
import signal
import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.dashboard.command import ZENFI, not_ours

FEW = """
name = "few"
runs = 1
mission = { seed = 7, limits = { mission_time_s = 6.0 } }
arms = [{ name = "pid", fault = { target = "pid" } }, { name = "octomap", fault = { target = "octomap" } }]
"""


def be_another_process() -> None:
    """Nice, on one processor, with signals and descriptors as few have them."""
    os.nice(5)
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for _ in range(15):
        os.set_inheritable(os.open(os.devnull, os.O_RDONLY), True)


def said(
    arguments: tuple[object, ...], environment: Mapping[str, str], folder: Path, prepare: Callable[[], None]
) -> list[Any]:
    done = subprocess.run(
        [ZENFI, *map(str, arguments), "--json"],
        env=environment,
        cwd=folder,
        preexec_fn=prepare,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        check=True,
    )
    return [json.loads(line) for line in done.stdout.splitlines()]


def answers(folder: Path, *arguments: object) -> list[list[Any]]:
    """What a command says here, in another shell and as another kind of process."""
    other = not_ours(folder / "other")
    variables = {f"MORE_{number}": "y" * number for number in range(50)}
    shell = {**os.environ, **variables, "PATH": f"{os.environ['PATH']}:/{'x' * 90}", "LANG": "de_DE.UTF-8"}
    small = {
        "PATH": "/usr/bin:/bin",
        "HOME": str(other),
        "XDG_CACHE_HOME": os.environ.get("XDG_CACHE_HOME", ""),
    }
    return [
        said(arguments, os.environ, Path.cwd(), lambda: None),
        said(arguments, shell, other, lambda: None),
        said(arguments, small, Path("/"), be_another_process),
    ]


def flown(outcome: dict[str, Any]) -> dict[str, Any]:
    """All of an injected flight that may not differ."""
    record = dict(outcome["injection"])
    for of_this_machine in ("pid", "tid", "pause_us", "threads_stopped"):
        del record[of_this_machine]
    return {"digest": outcome["digest"], "qof": outcome["qof"], **record}


def differences(one: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """What differs, whole: each field as it is in both."""
    return {name: (one[name], other.get(name)) for name in one if one[name] != other.get(name)}


@pytest.mark.parametrize(
    "kernel", ["pid", *(pytest.param(kernel, marks=pytest.mark.soak) for kernel in ("octomap", "rrt_star"))]
)
def test_the_first_flight_of_a_fault_is_the_same_everywhere(tmp_path: Path, kernel: str) -> None:
    fault = f"instruction:{kernel}"
    found = answers(tmp_path, "fly", "--seed", 7, "--fault", fault, "--fault-seed", 3)
    assert found[0][0]["injection"]["precision"] == "exact"
    here, *elsewhere = [flown(lines[0]) for lines in found]
    assert [differences(here, there) for there in elsewhere] == [{}, {}]


@pytest.mark.soak
def test_a_campaign_of_faults_is_the_same_everywhere(tmp_path: Path) -> None:
    (tmp_path / "few.toml").write_text(FEW)
    found = []
    for number, slots in enumerate((1, 2)):
        run = ("campaign", "run", tmp_path / "few.toml", "--store", tmp_path / str(number), "--slots", slots)
        here = not_ours(tmp_path / "other") if number else tmp_path
        lines = said(run, os.environ, here, be_another_process if number else lambda: None)
        runs = {(one["arm"], one["index"]): flown(one["outcome"]) for one in lines if one.get("outcome")}
        found.append(runs)
    assert len(found[0]) == 2
    assert found[0] == found[1]


@pytest.mark.soak
def test_a_kernel_study_is_the_same_everywhere(tmp_path: Path) -> None:
    found = answers(tmp_path, "kernels", "run", "--kernel", "pid", "--injections", 20, "--seed", 5)
    runs = [[line for line in lines if "summary" not in line] for lines in found]
    assert len(runs[0]) == 20
    assert runs[0] == runs[1] == runs[2]
