"""Viewers are started on a recording with a layout that fits it; without one it is said what to install."""

import json
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from importlib.resources import files
from pathlib import Path

import pytest

from dashboard.analysis.recordings_reader import FlightRecording, open_run
from dashboard.viewers import blueprint
from dashboard.viewers.viewer import VIEWERS
from deploy.recording.derived import DERIVED
from tests.dashboard.recorded import flights

__all__ = ["flights"]

BIN = Path(sys.executable).parent
LAYOUTS = files("dashboard.viewers")


@pytest.fixture(scope="module")
def recording(flights: dict[str, Path]) -> FlightRecording:
    return open_run(flights["faulty"])


def view(flight: Path, path: str, home: Path, *more: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [BIN / "zenfi", "view", str(flight), *more],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PATH": path, "HOME": str(home)},
    )


def stand_in(folder: Path, program: str) -> Path:
    """A program of that name which writes down what it was asked, and which of that were files."""
    log = folder / f"{program}.log"
    script = folder / program
    script.write_text(f'#!/bin/sh\nfor each in "$@"; do [ -s "$each" ] && echo "file $each"; done >>{log}\n')
    script.chmod(0o755)
    return log


def test_without_a_viewer_it_is_said_what_to_install(flights: dict[str, Path], tmp_path: Path) -> None:
    done = view(flights["golden"], str(tmp_path), tmp_path)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert all(name in done.stderr for name in VIEWERS)
    one = view(flights["golden"], str(tmp_path), tmp_path, "--with", "plotjuggler")
    assert (one.returncode, "foxglove" in one.stderr) == (2, False)


def test_plotjuggler_and_foxglove_are_given_the_recording(flights: dict[str, Path], tmp_path: Path) -> None:
    flight = flights["golden"]
    path = f"{tmp_path}:/usr/bin:/bin"
    juggler, foxglove = stand_in(tmp_path, "plotjuggler"), stand_in(tmp_path, "foxglove-studio")
    assert view(flight, path, tmp_path).returncode == 0
    assert [line.rpartition("/")[2] for line in juggler.read_text().splitlines()] == [
        "golden.mcap",
        "plotjuggler.xml",
    ]
    shown = view(flight, path, tmp_path, "--with", "foxglove")
    assert shown.returncode == 0
    assert foxglove.read_text() == f"file {flight}\n"
    assert "foxglove.json" in shown.stderr  # the layout that is to be imported


def test_rerun_is_given_the_flight_and_the_blueprint(flights: dict[str, Path], tmp_path: Path) -> None:
    log, real = tmp_path / "rerun.log", BIN / "rerun"
    script = tmp_path / "rerun"
    script.write_text(
        f'#!/bin/sh\n[ "$1" = mcap ] && exec {real} "$@"\n'
        f'{real} rrd verify "$@" >>{log} 2>&1 && echo "$@" >>{log}\n'
    )
    script.chmod(0o755)
    done = view(flights["golden"], f"{tmp_path}:/usr/bin:/bin", tmp_path)
    assert done.returncode == 0, done.stderr
    last = log.read_text().splitlines()[-1].split()
    assert [Path(one).name for one in last] == ["golden.rrd", "zenfi.rbl"]
    assert not Path(last[0]).exists()  # what was made for the viewer is gone with it


def test_the_layouts_name_what_is_in_a_recording(recording: FlightRecording) -> None:
    curves = ET.fromstring((LAYOUTS / "plotjuggler.xml").read_text()).iter("curve")  # noqa: S314
    names = [curve.attrib["name"] for curve in curves]
    layout = (LAYOUTS / "foxglove.json").read_text()
    json.loads(layout)
    paths = re.findall(r'"(?:value|topicPath)": "/(\w+)\.([\w.]+)"', layout)
    assert len(paths) == 9
    for topic, field in [*((name[1:].split("/", 1)) for name in names), *paths]:
        assert field.replace("/", ".") in recording.table(topic), (topic, field)
    panel = json.loads(layout)["configById"]
    topics = [*panel["3D!flight"]["topics"], *panel["Image!depth"]["imageMode"].values()]
    shown = {one[1:] for one in topics if isinstance(one, str) and one.startswith("/")}
    shown |= {*blueprint.DRAWN, *blueprint.PLOTTED}
    # Nothing moves in this world.
    assert shown - {"moving_obstacles"} <= set(recording.messages)
    assert {"obstacles", "vehicle", "planned_path", "cloud", "depth"} <= shown
    assert set(DERIVED) - {"moving_obstacles"} <= set(recording.messages)
