"""An outcome that stands for others is found by every process that has the same folder."""

import os
from pathlib import Path

import pytest

from deploy.pairing import flown_outcomes
from deploy.pairing.flown_outcomes import FlownOutcomes
from services.models.mission import MissionSpec
from services.models.outcome import NO_FLIGHT, Outcome

NAME, OTHER = "0a", "0b"


def outcome(digest: str) -> Outcome:
    return Outcome(
        spec=MissionSpec(), result="success", qof=NO_FLIGHT, wall_s=1.0, digest=digest, nodes={}, topics={}
    )


def of(folder: Path | None) -> FlownOutcomes:
    outcomes = FlownOutcomes()
    outcomes.share(folder)
    return outcomes


def test_what_one_process_keeps_another_finds(tmp_path: Path) -> None:
    of(tmp_path / "flown").keep(NAME, outcome("one"))
    other = of(tmp_path / "flown")
    assert other.find(NAME) == outcome("one")
    assert other.find(OTHER) is None
    assert of(None).find(NAME) is None
    assert [one.name for one in (tmp_path / "flown").iterdir()] == [f"{NAME}.json"]


def test_a_file_that_is_none_is_flown_again(tmp_path: Path) -> None:
    (tmp_path / f"{NAME}.json").write_text('{"result": "succ')
    outcomes = of(tmp_path)
    assert outcomes.find(NAME) is None
    outcomes.keep(NAME, outcome("two"))
    assert of(tmp_path).find(NAME) == outcome("two")


def test_without_room_the_outcome_is_remembered_all_the_same(tmp_path: Path) -> None:
    nowhere = tmp_path / "no" / "such"
    outcomes = of(nowhere)
    outcomes.keep(NAME, outcome("three"))
    assert outcomes.find(NAME) == outcome("three")


def test_the_oldest_files_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flown_outcomes, "IN_FOLDER", 2)
    for age, name in enumerate("abcd"):
        (tmp_path / f"{name}.json").write_text(outcome(name).model_dump_json(by_alias=True))
        os.utime(tmp_path / f"{name}.json", (1e9 - age, 1e9 - age))
    of(tmp_path)
    assert sorted(one.name for one in tmp_path.iterdir()) == ["a.json", "b.json"]
