"""Fig. 15: the paper's factors beside ours, and what makes them so."""

import csv
import re
from pathlib import Path

import pytest

from dashboard.studies.redundant_computers import RedundantComputers, verdict, write
from sim.vehicle.airframe import BadAirframeError


def test_what_was_fitted_is_not_called_confirmed(tmp_path: Path) -> None:
    write(tmp_path, RedundantComputers())
    page = (tmp_path / "README.md").read_text()
    rows = re.findall(r"^\| (\w+) \| TMR \|.*\| x ([\d.]+) \| x ([\d.]+) \| (.*) \|$", page, re.MULTILINE)
    assert rows == [("airsim", "1.06", "1.06", "agrees"), ("spark", "1.90", "1.91", "fitted")]
    assert "**Fitted**" in page
    assert "<svg" in (tmp_path / "quality.svg").read_text()
    with (tmp_path / "times.csv").open(newline="") as file:
        written = [(row["airframe"], row["scheme"]) for row in csv.DictReader(file)]
    assert written == [
        (frame, scheme) for frame in ("airsim", "spark") for scheme in ("simplex", "DMR", "TMR")
    ]


def test_another_weight_of_a_computer_does_not_confirm_the_paper(tmp_path: Path) -> None:
    heavy = RedundantComputers(computer_kg=0.18)
    assert [verdict(frame, heavy.of(frame)[2]) for frame in heavy.airframes] == ["not confirmed"] * 2
    write(tmp_path, heavy)
    assert "cannot fly" in (tmp_path / "README.md").read_text()


def test_an_airframe_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadAirframeError, match="absent"):
        write(tmp_path, RedundantComputers(airframes=("absent",)))
