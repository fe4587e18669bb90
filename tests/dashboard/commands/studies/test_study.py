"""``zenfi study``: from flights to a page, tables and a figure; what is there is not flown again."""

import csv
import json
import re
from contextlib import closing
from pathlib import Path

import pytest
from pyarrow import parquet

from dashboard.campaigns.store.store import Store
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
    assert [one["name"] for one in told] == [*TABLE]
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
    for name in ("README.md", "findings.csv", "runs.csv", "campaign.json"):
        assert (tmp_path / "again" / name).read_bytes() == (folder / name).read_bytes()
    with closing(Store(str(store))) as opened:
        assert [one.label for one in opened.campaigns()] == ["table3-1"]


def test_bad_input_is_one_clear_line(tmp_path: Path) -> None:
    assert "table3" in refusal("study", "run", "demo", "--store", tmp_path / "store")
    assert "absent.toml" in refusal("study", "run", tmp_path / "absent.toml", "--store", tmp_path / "store")
