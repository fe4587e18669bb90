"""``zenfi evidence``: files to hand in, of real flights, every figure of which comes out again."""

import csv
import json
from pathlib import Path
from typing import Any

import pytest

from tests.dashboard.command import refusal, zenfi

SPEC = """
name = "claimed"
runs = 2
[mission]
seed = 7
limits = { mission_time_s = 8.0 }
properties = ["always deviation <= 0.01"]
[[arms]]
name = "bare"
[[arms]]
name = "watched"
mission = { detector = { scheme = "gaussian", retries = 1 } }
[[faults]]
name = "exponent"
[faults.fault]
level = "source"
target = "command.vx"
bit_numbers = [62]
trigger = { invocation = 120 }
[[faults]]
name = "nothing"
fault = { level = "source", target = "command.vx", model = "none" }
"""

BUDGET = """
name = "Delivery"
target_per_hour = 1e-12
[[elements]]
name = "commands"
arm = "bare"
fault = "exponent"
fit = { value = 20, low = 5, high = 80, source = "made up" }
flux = { value = 3, source = "made up" }
share = { value = 0.5, source = "made up" }
[[elements]]
name = "harmless"
campaign = "claimed-1"
arm = "bare"
fault = "nothing"
fit = { value = 1, source = "made up" }
flux = { value = 3, source = "made up" }
share = { value = 0.5, source = "made up" }
"""


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the store of a campaign, a budget and the evidence of both."""
    folder = tmp_path_factory.mktemp("claim")
    (folder / "claimed.toml").write_text(SPEC)
    (folder / "budget.toml").write_text(BUDGET)
    answer = zenfi("campaign", "run", folder / "claimed.toml", "--store", folder, "--json")
    assert answer.returncode == 0, answer.stderr
    assert zenfi("replay", "claimed-1", "--store", folder).returncode == 0
    answer = evidence(folder, "claimed-1", "--budget", folder / "budget.toml")
    assert answer.returncode == 0, answer.stderr
    assert "does not meet the target" in answer.stdout
    return folder


def evidence(folder: Path, *arguments: object) -> Any:
    return zenfi("evidence", *arguments, "--store", folder, "--output", folder / "evidence")


def document(folder: Path) -> dict[str, Any]:
    told: dict[str, Any] = json.loads((folder / "evidence" / "evidence.json").read_text())
    return told


def test_the_ledger_has_a_line_for_each_element(written: Path) -> None:
    found = document(written)
    commands, harmless = found["lines"]
    assert (commands["struck"], commands["manifested"]) == (2, 2)
    assert 1 <= commands["harmed"] == len(found["dominant"]) <= 2
    # Nothing was struck: all upsets may harm.
    assert (harmless["struck"], harmless["not_injected"]) == (0, 2)
    assert harmless["bound_per_hour"] == pytest.approx(1.5e-9, rel=1e-9)
    # 20e-9 * 3 * 0.5
    assert commands["rate_per_hour"] == pytest.approx(3e-8 * commands["harmed"] / 2, rel=1e-9)
    assert harmless["rate_per_hour"] == 0.0
    assert found["bound_per_hour"] > found["rate_per_hour"]
    with (written / "evidence" / "ledger.csv").open(newline="") as file:
        assert [row["element"] for row in csv.DictReader(file)] == ["commands", "harmless"]


def test_each_fault_that_dominates_is_flown_again_by_its_command(written: Path) -> None:
    found = document(written)
    assert all(one["harm"] == ["property_violated"] for one in found["dominant"])
    assert all(0 < one["margin_s"] < 4 for one in found["dominant"])
    command, *arguments = found["dominant"][0]["replay"].split()
    assert command == "zenfi"
    assert zenfi(*arguments, "--store", written).returncode == 0


def test_coverage_is_told_of_the_faults_that_harm_without_the_detector(written: Path) -> None:
    found = document(written)
    (coverage,) = found["coverage"]
    dangerous = found["lines"][0]["harmed"]
    assert (coverage["arm"], coverage["scheme"], coverage["dangerous"]) == ("watched", "gaussian", dangerous)
    assert coverage["caught"] == dangerous
    # Of all n: 0.05 ** (1 / n)
    assert coverage["caught_low"] == pytest.approx(0.05 ** (1 / dangerous), rel=1e-6)
    assert found["campaigns"][0]["replays"] == {"replayed": 8}


def test_every_figure_comes_out_again_and_one_that_does_not_is_named(written: Path, tmp_path: Path) -> None:
    answer = zenfi("evidence", "--rebuild", written / "evidence", "--store", tmp_path)
    assert answer.returncode == 0, answer.stderr
    assert "every figure came out again" in answer.stdout
    path = written / "evidence" / "evidence.json"
    kept = path.read_text()
    told = json.loads(kept)
    harmed = told["lines"][0]["harmed"]
    told["lines"][0]["harmed"] = 0
    try:
        path.write_text(json.dumps(told))
        answer = zenfi("evidence", "--rebuild", written / "evidence", "--store", tmp_path)
    finally:
        path.write_text(kept)
    assert answer.returncode == 1
    assert answer.stdout.splitlines() == [f"lines[0].harmed: 0 in the file, {harmed} now"]


def test_bad_input_is_one_clear_line(written: Path, tmp_path: Path) -> None:
    assert "--budget" in refusal("evidence", "claimed-1", "--store", written)
    whole, budget = written / "budget.toml", tmp_path / "budget.toml"
    assert "absent-1" in refusal("evidence", "absent-1", "--budget", whole, "--store", written)
    budget.write_text(BUDGET.replace('fault = "exponent"', 'fault = "exponents"'))
    asked = ("evidence", "claimed-1", "--store", written, "--output", tmp_path / "e")
    assert "no such cell" in refusal(*asked, "--budget", budget)
    assert not (tmp_path / "e").exists()
    assert "evidence.json" in refusal("evidence", "--rebuild", tmp_path, "--store", written)
