"""``zenfi detect``: harmful faults are flown and kept, and schemes are judged on them."""

import json
import re
import shutil
from pathlib import Path

import pytest

from detector.series.series import load_folder
from tests.dashboard.command import refusal, zenfi


@pytest.fixture(scope="module")
def recorded(collected: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    for part in ("1/2", "2/2"):
        answer = zenfi("detect", "record", collected[1], "--output", folder, "--golden", 4, "--part", part)
        assert answer.returncode == 0, answer.stderr
    return folder


def test_harmful_flights_are_kept_with_their_harm_beside_golden_ones_of_the_same_missions(
    recorded: Path,
) -> None:
    harmful, golden = load_folder(recorded / "harmful"), load_folder(recorded / "golden")
    assert [len(harmful), len(golden)] == [2, 4]
    for one in harmful:
        told = one.about["harm"]
        assert (told["target"], told["fault_class"], told["pilot"]) == (
            "command.velocity",
            "permanent",
            "guarded",
        )
        assert told["injected_s"] < told["harmed_at_s"] <= 8.0
    assert len({one.spec.seed for one in (*harmful, *golden)}) == 6
    for one in golden:
        mission = harmful[0].spec.model_copy(update={"fault": None, "seed": one.spec.seed})
        assert one.spec == mission


def test_what_is_there_is_not_flown_again_and_a_larger_collection_loses_nothing(
    recorded: Path, collected: tuple[Path, Path], tmp_path: Path
) -> None:
    before = {path: path.stat().st_mtime_ns for path in recorded.rglob("*.npz")}
    one = tmp_path / "one.jsonl"
    one.write_text(collected[1].read_text().splitlines(keepends=True)[0])
    assert zenfi("detect", "record", one, "--output", recorded, "--golden", 4).returncode == 0
    assert {path: path.stat().st_mtime_ns for path in recorded.rglob("*.npz")} == before


def test_schemes_are_compared_at_the_same_false_alarms(recorded: Path, tmp_path: Path) -> None:
    page = tmp_path / "detectors.md"
    answer = zenfi("detect", "evaluate", recorded, "--json", "--page", page)
    assert answer.returncode == 0, answer.stderr
    found = {told["scheme"]: told for told in map(json.loads, answer.stdout.splitlines())}
    assert set(found) >= {"gaussian", "autoencoder", "kinematic"}
    assert 0.0 < found["autoencoder"]["compute_share"] < 0.42e-4  # the paper's Table V
    kernels_s, time_s = (
        sum(one.about[name] for one in load_folder(recorded / "golden")) for name in ("kernels_s", "time_s")
    )
    assert found["reexecution"]["compute_share"] == pytest.approx(kernels_s / time_s)
    assert 0.1 < kernels_s / time_s < 3.0  # three stages, each busy for a part of the time
    for told in found.values():
        assert [one["budget"] for one in told["budgets"]] == ["0.1 a flight", "1 in 100 h"]
        assert {(one["golden_flights"], one["harmful"]) for one in told["budgets"]} == {(2, 2)}
        for one in told["budgets"]:
            caught = sum(fault["in_time"] for fault in one["faults"])
            assert one["caught_in_time"] == caught
            assert one["bounds"]["0.95"] == pytest.approx((0.0, 1 - 0.95**0.5, 0.05**0.5)[caught])
    assert "\n| data | 2 |" in page.read_text()
    assert "| guarded | permanent | command.velocity | data | 2 |" in page.read_text()


def test_variants_of_the_papers_schemes_are_judged_alike(recorded: Path, tmp_path: Path) -> None:
    page, wanted = tmp_path / "ablation.md", ("GAD", "GAD, 25 ticks", "AAD, not cubed")
    options = [part for name in wanted for part in ("--variant", name)]
    answer = zenfi("detect", "ablation", recorded, *options, "--page", page)
    assert answer.returncode == 0, answer.stderr
    rows = re.findall(r"^\| (\w[^|]*) \| 0.1 a flight \|.* (\d) of 2 \|", page.read_text(), re.MULTILINE)
    assert [name for name, _ in rows] == ["AAD, not cubed", "GAD", "GAD, 25 ticks"]
    said = refusal("detect", "ablation", recorded, "--variant", "AAD, blind")
    assert "AAD, blind" in said


def test_bad_input_is_one_clear_line(recorded: Path, tmp_path: Path) -> None:
    assert "makes one" in refusal("detect", "record", tmp_path / "absent", "--output", tmp_path / "out")
    for part in ("0/2", "3/2", "2", "a/b", "1/2/3"):
        said = refusal("detect", "record", tmp_path / "any", "--output", tmp_path / "out", "--part", part)
        assert f"--part {part}" in said
    assert not (tmp_path / "out").exists()
    assert "no recorded flight" in refusal("detect", "evaluate", tmp_path)
    assert "oracle" in refusal("detect", "evaluate", recorded, "--scheme", "oracle")


DOCS = Path(__file__).parents[3] / "docs" / "detection.md"


@pytest.fixture(scope="module")
def sealed(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """What is left of the recorded flights, and what was taken away."""
    folder = tmp_path_factory.mktemp("sealed")
    shutil.copytree(recorded, folder / "open")
    answer = zenfi("detect", "seal", folder / "open", "--output", folder / "sealed")
    assert answer.returncode == 0, answer.stderr
    assert answer.stdout.count("1 harmful and 2 golden flights") == 2
    return folder / "open", folder / "sealed"


def test_half_of_the_flights_are_taken_away_and_none_is_lost(
    recorded: Path, sealed: tuple[Path, Path]
) -> None:
    left, taken = ({path.name for path in folder.rglob("*.npz")} for folder in sealed)
    assert not left & taken
    assert left | taken == {path.name for path in recorded.rglob("*.npz")}


def test_a_program_written_from_the_page_is_ranked(sealed: tuple[Path, Path], tmp_path: Path) -> None:
    (program,) = re.findall(r"^```python\n(#!.*?)^```$", DOCS.read_text(), re.MULTILINE | re.DOTALL)
    ewma, page = tmp_path / "ewma", tmp_path / "league.md"
    ewma.write_text(program)
    ewma.chmod(0o755)
    answer = zenfi("detect", "league", ewma, "--data", sealed[1], "--page", page, "--json")
    assert answer.returncode == 0, answer.stderr
    told = [json.loads(line) for line in answer.stdout.splitlines()]
    assert [one["place"] for one in told] == list(range(1, len(told) + 1))
    assert [one["scheme"] for one in told if one["entry"]] == ["ewma"]
    caught = [one["budgets"][0]["caught_in_time"] for one in told]
    assert caught == sorted(caught, reverse=True)
    assert "# League: ewma among 6 others" in page.read_text()
    shown = zenfi("detect", "league", ewma, "--data", sealed[1])
    assert "ewma is number " in shown.stdout


def test_what_cannot_be_ranked_or_sealed_is_one_clear_line(sealed: tuple[Path, Path], tmp_path: Path) -> None:
    assert "oracle" in refusal("detect", "league", "oracle", "--data", sealed[1])
    assert "pyproject.toml" in refusal("detect", "league", tmp_path, "--data", sealed[1])
    assert "too few to divide" in refusal("detect", "seal", sealed[1], "--output", tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert "not empty" in refusal("detect", "seal", sealed[0], "--output", sealed[1])
