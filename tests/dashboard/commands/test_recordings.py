"""``zenfi propagation`` and ``zenfi up --foxglove``: what a user types and is told."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from dashboard.commands.recordings import propagation
from deploy.compose.reading import read_stack
from deploy.errors import BadSpecError
from tests.dashboard.command import refusal
from tests.dashboard.recorded import flights

__all__ = ["flights"]


@pytest.mark.soak
def test_the_way_of_an_error_is_printed_told_as_json_and_drawn(
    flights: dict[str, Path], tmp_path: Path
) -> None:
    pair, dot = [str(flights["faulty"]), str(flights["golden"])], tmp_path / "ways.dot"
    shown = CliRunner().invoke(propagation, [*pair, "--dot", str(dot)], catch_exceptions=False)
    assert "planning was injected" in shown.output
    told = json.loads(CliRunner().invoke(propagation, [*pair, "--json"]).output)
    first = told["propagation"]["topics"][0]
    assert (first["topic"], first["causes"], first["fields"]) == ("trajectory", ["fault"], ["x"])
    assert {one["topic"] for one in told["growth"]} >= {"trajectory", "command", "odometry"}
    assert '"fault" -> "trajectory"' in dot.read_text()


def test_only_a_flight_and_its_own_twin_are_compared(flights: dict[str, Path], tmp_path: Path) -> None:
    swapped = [str(flights["golden"]), str(flights["faulty"])]
    with pytest.raises(BadSpecError, match=r"faulty\.mcap: not the golden twin"):
        CliRunner().invoke(propagation, swapped, catch_exceptions=False)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(flights["faulty"].read_bytes()[:-1000])
    with pytest.raises(BadSpecError, match=r"cut\.mcap: the flight was killed"):
        CliRunner().invoke(propagation, [str(cut), str(flights["golden"])], catch_exceptions=False)
    with pytest.raises(BadSpecError, match="its own twin"):
        CliRunner().invoke(propagation, [str(flights["golden"])], catch_exceptions=False)


def test_a_recording_has_to_have_a_folder(tmp_path: Path) -> None:
    assert "record" in refusal("fly", "--record", tmp_path / "none" / "run.mcap")


def test_the_laboratory_has_foxglove_if_it_is_asked_for() -> None:
    assert "foxglove" not in read_stack(None).processes
    both = read_stack(None, foxglove=True).processes
    assert list(both["foxglove"].command) == ["zenfi", "foxglove"]
    assert "api" in both
