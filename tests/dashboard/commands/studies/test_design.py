"""``zenfi study design``: a front of designs, whose predictions are held against what is flown."""

import json
from contextlib import closing
from pathlib import Path

import pytest

from dashboard.campaigns.spec import load_campaign
from dashboard.campaigns.store.store import Store
from tests.dashboard.command import refusal, zenfi
from tests.dashboard.design.synthetic import SPEC, TRUTH, Truth, stored

ELEMENT = """
[[elements]]
name = "{0}"
arm = "bare"
fault = "{0}"
fit = {{ value = 20, low = 5, high = 80, source = "made up" }}
flux = {{ value = 3, source = "made up" }}
share = {{ value = 0.5, source = "made up" }}
"""
BUDGET = 'name = "Delivery"\ndraws = 2000\n' + ELEMENT.format("pid") + ELEMENT.format("way")

FLOWN = """
name = "flown"
runs = 2
[mission]
seed = 7
limits = { mission_time_s = 60.0 }
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
"""


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a store, whose campaign was drawn and not flown, a budget and what was found."""
    folder = tmp_path_factory.mktemp("design")
    (folder / "budget.toml").write_text(BUDGET)
    with closing(Store(folder)) as store:
        stored(store, SPEC)
    answer = design(folder, "options-1", "--budget", folder / "budget.toml", "--output", folder / "design")
    assert answer.startswith(f"{folder / 'design' / 'README.md'}: ")
    assert "of them on the front" in answer
    return folder


def design(folder: Path, *arguments: object, status: int = 0) -> str:
    answer = zenfi("study", "design", *arguments, "--store", folder)
    assert answer.returncode == status, answer.stderr
    return answer.stdout


def fly(folder: Path, name: str, truth: Truth = TRUTH) -> str:
    """Store what a design's campaign would come to; its label."""
    with closing(Store(folder)) as store:
        return stored(store, load_campaign(str(folder / f"design/campaigns/{name}.toml")), truth).label


def test_the_folder_has_page_document_table_figure_and_campaigns(written: Path) -> None:
    files = {one.name for one in (written / "design").iterdir()}
    assert files == {"README.md", "design.json", "front.csv", "designs.svg", "campaigns"}
    found = json.loads((written / "design" / "design.json").read_text())
    assert len(found["front"]) >= 3
    assert found["front"] == sorted(found["front"], key=lambda one: one["bound_per_hour"])
    told = design(
        written, "options-1", "--budget", written / "budget.toml", "--json", "--output", written / "b"
    )
    assert json.loads(told) == found


def test_the_check_says_inside_or_outside_and_ends_so(written: Path) -> None:
    found = json.loads((written / "design" / "design.json").read_text())
    name = next(one["name"] for one in found["front"] if one["protections"])
    label = fly(written, name)
    told = design(written, "--check", written / "design", label)
    assert told.startswith(f"{name} ({label}): inside: ")
    other = fly(written, name, Truth(harm=TRUTH.harm, averts={}))
    told = design(written, "--check", written / "design", label, other, status=1)
    assert [line.split(": ")[1] for line in told.splitlines()] == ["inside", "outside"]
    (one,) = map(json.loads, design(written, "--check", written / "design", label, "--json").splitlines())
    assert (one["design"], one["inside"]) == (name, True)


def test_bad_input_is_one_clear_line(written: Path, tmp_path: Path) -> None:
    asked = ("study", "design", "options-1", "--store", written, "--output", tmp_path / "out")
    assert "--budget" in refusal(*asked)
    budget = tmp_path / "budget.toml"
    budget.write_text(BUDGET.replace('fault = "way"', 'fault = "ways"'))
    assert "element 'way'" in refusal(*asked, "--budget", budget)
    assert "range_m" in refusal(*asked, "--budget", written / "budget.toml", "--range-m", -1)
    assert "design.json" in refusal(*asked, "--check", tmp_path)
    assert not (tmp_path / "out").exists()


@pytest.mark.soak
def test_a_design_of_real_flights_is_flown_and_checked(tmp_path: Path) -> None:
    (tmp_path / "flown.toml").write_text(FLOWN)
    (tmp_path / "budget.toml").write_text('name = "Delivery"\n' + ELEMENT.format("exponent"))
    answer = zenfi("campaign", "run", tmp_path / "flown.toml", "--store", tmp_path, "--json")
    assert answer.returncode == 0, answer.stderr
    folder = tmp_path / "design"
    asked = ("flown-1", "--budget", tmp_path / "budget.toml", "--flights", 1)
    design(tmp_path, *asked, "--output", folder)
    found = json.loads((folder / "design.json").read_text())
    assert [one["name"] for one in found["protections"]] == ["watched"]
    (flying,) = [one for one in (*found["front"], *found["others"]) if one["protections"]]
    campaign = folder / flying["campaign"]
    answer = zenfi("campaign", "run", campaign, "--store", tmp_path, "--json")
    assert answer.returncode == 0, answer.stderr
    told = design(tmp_path, "--check", folder, f"{flying['name']}-2")
    assert ": inside: " in told
