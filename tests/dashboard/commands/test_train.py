"""``zenfi train`` as people and programs meet it."""

import json
from pathlib import Path

import pytest

from tests.dashboard.command import Answer, refusal, zenfi


def train(*arguments: object) -> Answer:
    return zenfi("train", *arguments)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flights")
    answer = train("record", "--output", folder, "--world", "sparse", "--seeds", "2")
    assert answer.returncode == 0, answer.stderr
    assert sorted(path.name for path in folder.iterdir()) == ["sparse-0000.npz", "sparse-0001.npz"]
    return folder


def test_train_and_evaluate_on_recorded_flights(recorded: Path, tmp_path: Path) -> None:
    model = tmp_path / "mine.json"
    assert train("kinematic", "--data", recorded, "--output", model).returncode == 0
    written = json.loads(model.read_text())
    assert written["provenance"]["worlds"] == ["sparse"]
    assert written["provenance"]["seeds"] == [0, 1]
    answer = train("evaluate", "--data", recorded, "--model", model, "--json")
    assert answer.returncode == 0, answer.stderr
    (line,) = answer.stdout.splitlines()
    result = json.loads(line)
    assert result["scheme"] == "kinematic"
    assert result["golden_flights"] == 2
    assert result["false_alarms"] == 0
    assert result["beyond_largest"]["rate"] == 1.0
    assert len(result["roc"]) > 20


@pytest.mark.soak
def test_flights_that_are_there_are_not_flown_again(recorded: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in recorded.iterdir()}
    assert train("record", "--output", recorded, "--world", "sparse", "--seeds", "2").returncode == 0
    assert {path: path.stat().st_mtime_ns for path in recorded.iterdir()} == before
    other = train("record", "--output", recorded, "--world", "sparse", "--seeds", "2", "--planner", "rrt")
    assert other.returncode == 2
    assert "another --output" in other.stderr


def test_bad_input_is_one_clear_line_and_status_2(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "rubbish").mkdir()
    (tmp_path / "rubbish" / "a.npz").write_bytes(b"PK")
    (tmp_path / "model.json").write_text("{")
    for arguments, says in (
        (("oracle", "--data", tmp_path / "empty"), "oracle"),
        (("gaussian", "--data", tmp_path / "empty"), "no recorded flight"),
        (("gaussian", "--data", tmp_path / "rubbish"), "a.npz"),
        (("evaluate", "--data", tmp_path / "rubbish", "--model", tmp_path / "model.json"), "truncated"),
        (("evaluate", "--data", tmp_path / "rubbish", "--scheme", "oracle"), "a.npz"),
        (("record", "--output", tmp_path / "x", "--world", "nowhere"), "nowhere"),
        (("record", "--output", tmp_path / "x", "--fault", "instruction:teapot"), "teapot"),
    ):
        assert says in refusal("train", *arguments)
    assert not (tmp_path / "x").exists()
