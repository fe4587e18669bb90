"""``docs/plug_ins.md``, carried out to the letter: a plug-in of each kind is installed, and flown."""

import json
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.scratch_environment import PLUG_INS as PAGE
from tests.scratch_environment import install_examples, zenfi

COMMANDS: list[str] = re.findall(r"^\$ zenfi (.*)$", PAGE.read_text(), re.MULTILINE)

pytestmark = pytest.mark.process


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the example, and an environment of its own that has it installed, and our packages."""
    folder = tmp_path_factory.mktemp("plug-ins")
    install_examples(folder)
    return folder


def flown(scratch: Path, arguments: str) -> dict[str, Any]:
    """The outcome of a flight, the last of those that were flown."""
    done = zenfi(scratch, f"{arguments} --json")
    assert done.returncode == 0, done.stderr
    outcome: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return outcome


def command(wanted: str) -> str:
    """The one command of the page that has this in it."""
    (found,) = [one for one in COMMANDS if wanted in one]
    return found


def test_every_kind_is_listed_and_works(scratch: Path) -> None:
    done = zenfi(scratch, "plugins --json")
    listed = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == 0
    assert {one["kind"] for one in listed if one["package"] == "zenfi-examples"} == {
        "guard",
        "mask",
        "pilot",
        "planner",
        "signal",
        "world",
    }
    assert {one["problem"] for one in listed} == {""}


@pytest.mark.parametrize("line", COMMANDS)
def test_each_command_of_the_page_works(scratch: Path, line: str) -> None:
    done = zenfi(scratch, line)
    assert done.returncode == 0, done.stderr


def test_a_name_of_ours_hides_that_of_another_package(scratch: Path) -> None:
    entries = next(
        (scratch / ".venv").glob("lib/*/site-packages/zenfi_examples-*.dist-info/entry_points.txt")
    )
    whole = entries.read_text()
    entries.write_text(whole.replace("spiral =", "sparse ="))
    try:
        done = zenfi(scratch, "plugins --json")
    finally:
        entries.write_text(whole)
    problems = [one["problem"] for one in map(json.loads, done.stdout.splitlines()) if one["problem"]]
    assert problems == ["zenfi has a world of that name, which is used instead"]
    assert done.returncode == 1


def test_a_planner_is_struck_and_repeats(scratch: Path) -> None:
    one, other = (flown(scratch, command("instruction:bit_star")) for _ in range(2))
    assert one["digest"] == other["digest"]
    assert one["injection"]["node"] == "planning"
    assert one["injection"]["module"].startswith("libompl")
    assert one["nodes"]["planning"]["kernels"]["bit_star"]["invocations"] > 0


def test_a_world_a_pilot_and_a_signal(scratch: Path) -> None:
    outcome = flown(scratch, command("spiral"))
    assert (outcome["result"], outcome["spec"]["pilot"]) == ("success", "gentle")
    (judged,) = outcome["properties"]
    assert judged["holds"]
    assert 0.0 < judged["robustness"] < 1.5


def test_a_guard_refuses_the_corrupted_trajectory_and_is_counted(scratch: Path) -> None:
    outcome = flown(scratch, command("near"))
    assert outcome["nodes"]["control"]["guards"]["near"] == 1
    assert "near" not in outcome["nodes"]["planning"]["guards"]


def test_a_mask_is_written_out(scratch: Path) -> None:
    fault = flown(scratch, command("mask=double"))["spec"]["fault"]
    assert (fault["mask"], fault["histogram"]["bits"]) == ("histogram", {"1": 0.9, "2": 0.1})


def test_parameters_of_a_generator_are_checked(scratch: Path) -> None:
    text = PAGE.read_text().split("```toml\nname")[1].split("```")[0]
    (scratch / "wide.toml").write_text(f"name{text}")
    (scratch / "none.toml").write_text(f"name{text}".replace("towers = 40", "towers = 0"))
    assert zenfi(scratch, "world show wide.toml --json").returncode == 0
    refused = zenfi(scratch, "world show none.toml")
    assert refused.returncode == 2
    assert "generator spiral: parameters.towers: Input should be greater than or equal to 3" in refused.stderr


def test_a_broken_plug_in_is_named(scratch: Path) -> None:
    module = next((scratch / ".venv" / "lib").iterdir()) / "site-packages" / "zenfi_examples.py"
    whole = module.read_text()
    module.write_text(whole.replace("SPIRAL = ", "OTHER = "))
    try:
        listed = zenfi(scratch, "plugins")
        refused = zenfi(scratch, "fly --world spiral")
    finally:
        module.write_text(whole)
    assert listed.returncode == 1
    assert "not usable" in listed.stdout
    assert "world 'spiral' (zenfi_examples:SPIRAL) cannot be imported" in listed.stderr
    assert refused.returncode == 2
    assert "world 'spiral' (zenfi_examples:SPIRAL) cannot be imported" in refused.stderr


def test_what_is_known_of_flights_holds_for_the_bytes_of_a_plug_in(scratch: Path) -> None:
    def digest() -> str:
        asked = [".venv/bin/python", "-c", "from services.system import plug_ins; print(plug_ins.digest())"]
        return subprocess.run(asked, cwd=scratch, capture_output=True, text=True, check=True).stdout.strip()

    module = next((scratch / ".venv" / "lib").iterdir()) / "site-packages" / "zenfi_examples.py"
    whole, before = module.read_text(), digest()
    module.write_text(whole.replace("FARTHEST_M = 200.0", "FARTHEST_M = 201.0"))
    changed = digest()
    module.write_text(whole)
    assert digest() == before != changed
    assert "" not in (before, changed)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            "--planner bitstar",
            "unknown planner 'bitstar'; known: rrt, rrt_connect, rrt_star, prm_star, bit",
        ),
        ("--pilot gentl", "unknown pilot 'gentl'; known: guarded, baseline, gentle"),
        ("--guards far", "unknown guard 'far'; known: finite, range"),
        ("--property 'always fall >= 2'", "unknown signal 'fall'; known: clearance"),
        ("--fault instruction:bit_star", "choose --planner bit_star"),
    ],
)
def test_a_name_that_nobody_has_is_refused_with_those_that_are_known(
    scratch: Path, arguments: str, said: str
) -> None:
    done = zenfi(scratch, f"fly {arguments}")
    assert done.returncode == 2
    assert said in done.stderr
