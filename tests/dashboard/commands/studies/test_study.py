"""``zenfi study``: from flights to a page, tables and a figure; what is there is not flown again."""

import csv
import json
import re
from contextlib import closing
from pathlib import Path

import pytest
from pyarrow import parquet

from dashboard.campaigns.store.store import Store
from dashboard.studies.kernels_alone import KERNELS, statements
from dashboard.studies.study import TABLE
from tests.dashboard.command import refusal, zenfi


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The smallest Table III, and the store that has its flights."""
    folder = tmp_path_factory.mktemp("study")
    answer = study(folder / "store", "table3", "--scale", 0.01, "--output", folder / "table3")
    assert "4 runs of table3-1" in answer
    return folder / "table3", folder / "store"


def study(store: Path, *arguments: object) -> str:
    answer = zenfi("study", "run", *arguments, "--store", store)
    assert answer.returncode == 0, answer.stderr
    return answer.stdout


def test_all_studies_are_listed() -> None:
    told = [json.loads(line) for line in zenfi("study", "list", "--json").stdout.splitlines()]
    assert [one["name"] for one in told] == ["fig6", "fig15", *TABLE]
    assert {one["name"]: one["findings"] for one in told}["table3"] == 13
    shown = zenfi("study", "list").stdout
    assert all(one.title in shown for one in TABLE.values())


def test_a_study_leaves_a_page_tables_a_figure_and_its_specification(flown: tuple[Path, Path]) -> None:
    folder, _ = flown
    page = (folder / "README.md").read_text()
    assert page.startswith(f"# {TABLE['table3'].title}\n")
    assert "zenfi study run table3" in page
    rows = re.findall(r"^\| ([^|]+) \| % \| ([\d.]+) \| ([\d.]+) \(.*\) \| (.+) \|$", page, re.MULTILINE)
    assert ("golden: success", "100.0", "100.0", "confirmed") in rows
    with (folder / "findings.csv").open(newline="") as file:
        written = {row["what"]: row for row in csv.DictReader(file)}
    assert len(written) == 13
    assert float(written["golden: success"]["low"]) < 100.0
    assert parquet.read_table(folder / "runs.parquet").num_rows == 4
    assert len((folder / "cells.csv").read_text().splitlines()) == 5
    assert "<svg" in (folder / "quality.svg").read_text()


def test_a_page_is_made_again_from_its_specification_without_a_flight(
    flown: tuple[Path, Path], tmp_path: Path
) -> None:
    folder, store = flown
    study(store, folder / "campaign.json", "--output", tmp_path / "again")
    for name in ("README.md", "findings.csv", "runs.csv", "quality.svg", "campaign.json"):
        assert (tmp_path / "again" / name).read_bytes() == (folder / name).read_bytes()
    with closing(Store(str(store))) as opened:
        assert [one.label for one in opened.campaigns()] == ["table3-1"]


def test_what_was_flown_is_mapped_by_place_bits_and_phase(flown: tuple[Path, Path], tmp_path: Path) -> None:
    _, store = flown
    answer = zenfi("study", "map", "table3-1", "--json", "--output", tmp_path / "map", "--store", store)
    assert answer.returncode == 0, answer.stderr
    told = [json.loads(line) for line in answer.stdout.splitlines()]
    assert sum(one["struck"] for one in told) == 3
    assert all("acceleration" in one["place"] or one["place"].startswith("trajectory.a") for one in told)
    assert "3 faults struck once" in (tmp_path / "map" / "README.md").read_text()
    assert "absent-1" in refusal("study", "map", "absent-1", "--store", store)


@pytest.mark.soak
@pytest.mark.parametrize("name", TABLE)
def test_every_study_is_made_at_a_tiny_scale_and_made_again(name: str, tmp_path: Path) -> None:
    store = tmp_path / "store"
    study(store, name, "--scale", 0.0001, "--output", tmp_path / name)
    page = (tmp_path / name / "README.md").read_text()
    assert page.startswith(f"# {TABLE[name].title}\n")
    assert ", 0 could not be flown." in page.replace("\n", " ")
    with (tmp_path / name / "cells.csv").open(newline="") as file:
        assert all(int(row["runs"]) >= 1 for row in csv.DictReader(file))
    study(store, tmp_path / name / "campaign.json", "--output", tmp_path / "again")
    assert (tmp_path / "again" / "runs.csv").read_bytes() == (tmp_path / name / "runs.csv").read_bytes()


def test_bad_input_is_one_clear_line(tmp_path: Path) -> None:
    assert "table3" in refusal("study", "run", "demo", "--store", tmp_path / "store")
    assert "absent.toml" in refusal("study", "run", tmp_path / "absent.toml", "--store", tmp_path / "store")


@pytest.fixture(scope="module")
def struck(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The smallest Fig. 6."""
    folder = tmp_path_factory.mktemp("kernels") / "fig6"
    answer = zenfi("study", "run", "fig6", "--scale", 0.0008, "--output", folder)
    assert answer.returncode == 0, answer.stderr
    assert "20 injections into 5 kernels" in answer.stdout
    return folder


def test_kernels_alone_leave_a_page_a_table_a_figure_and_every_injection(struck: Path) -> None:
    page = (struck / "README.md").read_text()
    assert page.startswith("# Fig. 6: a bit in one kernel alone\n")
    assert "4 injections into each of 5 kernels, drawn from seed 0" in page
    rows = re.findall(r"^\| ([^|]+) \| [^|]+ \| [^|]* \| (confirmed|not \w+) \|$", page, re.MULTILINE)
    assert [what for what, _ in rows] == [one.what for one in statements({})]
    with (struck / "outcomes.csv").open(newline="") as file:
        counts = [(row["kernel"], int(row["count"]), int(row["injected"])) for row in csv.DictReader(file)]
    for kernel in KERNELS:
        assert sum(count for name, count, _ in counts if name == kernel) == 4
    assert "<svg" in (struck / "quality.svg").read_text()


def test_a_page_of_kernels_is_made_again_from_its_specification(struck: Path, tmp_path: Path) -> None:
    answer = zenfi("study", "run", struck / "kernels.json", "--output", tmp_path)
    assert answer.returncode == 0, answer.stderr
    for name in ("README.md", "outcomes.csv", "quality.svg", "kernels.json", "injections.jsonl"):
        assert (tmp_path / name).read_bytes() == (struck / name).read_bytes()


def test_kernels_are_ranked_alone_and_in_flight(struck: Path, tmp_path: Path) -> None:
    campaign = tmp_path / "few.toml"
    campaign.write_text(
        'name = "few"\nruns = 1\n[mission]\nworld = "sparse"\n'
        + "".join(
            f'[[arms]]\nname = "{kernel}"\nfault = {{ target = "{kernel}" }}\n'
            for kernel in ("pid", "octomap", "rrt_star")
        )
    )
    store = tmp_path / "store"
    assert zenfi("campaign", "run", campaign, "--store", store).returncode == 0
    answer = zenfi("study", "ranks", struck / "injections.jsonl", "few-1", "--json", "--store", store)
    assert answer.returncode == 0, answer.stderr
    (found,) = map(json.loads, answer.stdout.splitlines())
    assert found["pilot"] == "guarded"
    told = {one["kernel"]: (one["injected"], one["struck"]) for one in found["kernels"]}
    assert told == dict.fromkeys(("octomap", "rrt_star", "pid"), (4, 1))
    assert found["low"] < 0 < found["high"]
    shown = zenfi("study", "ranks", struck / "injections.jsonl", "few-1", "--store", store).stdout
    assert "not resolved: the interval has 0 in it" in shown
    absent = refusal("study", "ranks", tmp_path / "absent.jsonl", "few-1", "--store", store)
    assert "zenfi kernels run --output" in absent


@pytest.mark.parametrize("name", ["fig6", "fig15"])
def test_what_flies_nothing_is_made_nowhere_else(name: str) -> None:
    assert "leave it out" in refusal("study", "run", name, "--executor", "dask")


def test_redundant_computers_leave_a_page_that_is_made_again(tmp_path: Path) -> None:
    assert "fig15/README.md: 2 airframes" in study(
        tmp_path / "store", "fig15", "--output", tmp_path / "fig15"
    )
    study(tmp_path / "store", tmp_path / "fig15" / "redundancy.json", "--output", tmp_path / "again")
    for name in ("README.md", "times.csv", "quality.svg", "redundancy.json"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "fig15" / name).read_bytes()
    (tmp_path / "absent.json").write_text('{"name": "fig15", "airframes": ["absent"]}')
    assert "absent" in refusal("study", "run", tmp_path / "absent.json", "--output", tmp_path / "again")


@pytest.mark.soak
def test_kernels_alone_and_in_flight_are_ranked_on_one_page(tmp_path: Path) -> None:
    folder = tmp_path / "ranked"
    study(tmp_path / "store", "kernel-vs-system", "--scale", 0.01, "--output", folder)
    page = (folder / "README.md").read_text()
    assert "## Kernels alone beside kernels in flight" in page
    assert page.count("Kendall's tau ") == 2
    with (folder / "ranks.csv").open(newline="") as file:
        rows = [(row["pilot"], row["kernel"], row["injected"]) for row in csv.DictReader(file)]
    kernels = TABLE["kernel-vs-system"].alone
    assert rows == [(pilot, kernel, "50") for pilot in ("baseline", "guarded") for kernel in kernels]
