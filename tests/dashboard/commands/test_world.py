"""Worlds, airframes and platforms as people handle them at the command line."""

from __future__ import annotations

import json
import struct
import tomllib
import xml.etree.ElementTree as ET
import zlib
from pathlib import Path

import numpy as np
import pytest

from deploy.mission.flight import fly
from deploy.mission.fork_server import ForkServer
from services.kernels import KERNELS
from services.models.mission import MissionSpec
from sim.vehicle.airframe import airframe
from sim.world import DEFINITION, make_world, to_toml
from tests.dashboard.command import refusal, zenfi


def test_an_exported_world_is_the_same_world_byte_for_byte(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    assert zenfi("world", "export", "dense", "--seed", "5", str(path)).returncode == 0
    first = path.read_bytes()
    again = make_world(DEFINITION.validate_python(tomllib.loads(first.decode())), 99)
    drawn = make_world("dense", 5)
    for name in ("obstacles", "bounds", "start", "goal"):
        assert getattr(again, name).tobytes() == getattr(drawn, name).tobytes()
    zenfi("world", "export", str(path), str(path))
    assert path.read_bytes() == first


@pytest.mark.soak
def test_a_flight_in_an_exported_world_is_the_flight_in_the_world(server: ForkServer) -> None:
    exported = DEFINITION.validate_python(tomllib.loads(to_toml(make_world("sparse", 7))))
    named, given = (fly(MissionSpec(world=world, seed=7), server).outcome for world in ("sparse", exported))
    assert given.digest == named.digest
    assert given.qof == named.qof


def test_show_prints_figures_and_draws_the_plan(tmp_path: Path) -> None:
    svg, png = tmp_path / "plan.svg", tmp_path / "plan.png"
    figures = json.loads(zenfi("world", "show", "factory", "--output", str(svg), "--json").stdout)
    assert {"density", "free_space", "start_clearance_m", "widest_way_m"} <= set(figures)
    rectangles = ET.fromstring(svg.read_text()).findall("{*}rect")  # noqa: S314 - our own file
    assert len(rectangles) >= figures["obstacles"]
    table = zenfi("world", "show", "factory", "--output", str(png))
    assert "free space" in table.stdout
    image = pixels(png.read_bytes())
    # North is up, 8 pixels a metre, margin 2 m: goal (20, 5) in a hall from (-43, -20) to (36, 30).
    assert image[(30 - 5 + 2) * 8, (20 + 43 + 2) * 8].tolist() == [0xC0, 0x39, 0x2B]
    assert image[(30 - 13 + 2) * 8, (-3 + 43 + 2) * 8].max() < 0x80, "a machine"


def pixels(content: bytes) -> np.ndarray:
    """RGB (h, w, 3) of a PNG without filters, each chunk's checksum checked."""
    assert content[:8] == b"\x89PNG\r\n\x1a\n"
    chunks, place = {}, 8
    while place < len(content):
        size, kind = struct.unpack(">I4s", content[place : place + 8])
        data = content[place + 8 : place + 8 + size]
        assert struct.unpack(">I", content[place + 8 + size : place + 12 + size])[0] == zlib.crc32(
            kind + data
        )
        chunks[kind] = data
        place += 12 + size
    width, height = struct.unpack(">II", chunks[b"IHDR"][:8])
    rows = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), dtype=np.uint8).reshape(height, -1)
    return rows[:, 1:].reshape(height, width, 3)


def test_every_world_is_listed_with_its_kind() -> None:
    lines = [json.loads(line) for line in zenfi("world", "list", "--json").stdout.splitlines()]
    assert {"name": "factory", "kind": "boxes"} in lines
    assert {"name": "dense", "kind": "grid"} in lines


GRID = 'name = "mine"\nkind = "grid"\n'


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (GRID + "density = 1.5\nobstacle_m = 3.0", "1.5"),
        (GRID + "density = 0.0\nobstacle_m = 3.0", "density 0"),
        (GRID + "density = 0.1\nobstacle_m = 11.0", "obstacle_m 11"),
        (GRID + "density = 0.1\nobstacle_m = 3.0\nwings = 2", "wings"),
        ('name = "mine"\nkind = "boxes"\nboxes = []', "boxes"),
        ('name = "mine"\nkind = "boxes"\nboxes = [[-26, 4, 0, -20, 9, 9]]', "start [-25, 5, 2]"),
        ('name = "mine"\nkind = "maze"', "maze"),
        ("name = ", "TOML"),
    ],
)
def test_a_bad_world_is_refused_with_its_value_in_one_line(text: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "world.toml"
    path.write_text(text)
    for command in (("fly", "--world", str(path)), ("world", "show", str(path))):
        assert says in refusal(*command)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("fly", "--world", "missing.toml"), "missing.toml"),
        (("fly", "--airframe", "kite"), "kite"),
        (("fly", "--airframe", "missing.toml"), "missing.toml"),
        (("fly", "--profile", "huge"), "huge"),
        (("fly", "--energy", "free"), "free"),
        (("fly", "--platform", "host"), "zenfi bench kernels"),
        (("world", "show", "nowhere"), "nowhere"),
        (("world", "show", "sparse", "--seed", "-1"), "-1"),
        (("world", "show", "sparse", "--output", "plan.gif"), "plan.gif"),
        (("world", "export", "sparse", "/nowhere/at/all.toml"), "/nowhere/at/all.toml"),
        (("world", "export", "sparse", "plan.txt"), "plan.txt"),
        (("redundancy", "--airframe", "kite"), "kite"),
        (("redundancy", "--range-m", "-1"), "-1"),
        (("bench", "kernels", "--output", "host.txt"), "host.txt"),
    ],
)
def test_bad_input_is_one_clear_line_and_status_2(arguments: tuple[str, ...], says: str) -> None:
    assert says in refusal(*arguments)


def test_an_airframe_and_a_platform_of_ones_own_fly_and_travel_in_the_outcome(tmp_path: Path) -> None:
    mine, slow = tmp_path / "mine.toml", tmp_path / "slow.toml"
    fields = airframe("airsim").model_dump() | {"name": "mine", "source": "", "max_rpm": 12000.0}
    mine.write_text("".join(f"{name} = {json.dumps(value)}\n" for name, value in fields.items()))
    latencies = "".join(f"{kernel} = {{ mean_ms = 5.0, jitter = 0.2 }}\n" for kernel in KERNELS)
    slow.write_text(f'name = "slow"\nsource = "a test"\n[kernels]\n{latencies}')
    answer = zenfi("fly", "--airframe", str(mine), "--platform", str(slow), "--json")
    outcome = json.loads(answer.stdout)
    assert outcome["qof"]["success"]
    assert outcome["spec"]["airframe"]["max_rpm"] == 12000.0
    assert outcome["spec"]["platform"]["name"] == "slow"


def test_the_redundancy_study_prints_its_three_schemes() -> None:
    lines = [
        json.loads(line) for line in zenfi("redundancy", "--airframe", "spark", "--json").stdout.splitlines()
    ]
    assert [line["scheme"] for line in lines] == ["simplex", "DMR", "TMR"]


@pytest.mark.soak
def test_measured_kernels_make_a_platform_file(tmp_path: Path) -> None:
    path = tmp_path / "host.toml"
    answer = zenfi("bench", "kernels", "--flights", "1", "--output", str(path), "--json")
    assert answer.returncode == 0
    measured = json.loads(answer.stdout)
    written = tomllib.loads(path.read_text())
    assert (written["kernels"], written["detectors"]) == (measured["kernels"], measured["detectors"])
    assert 0.0 < measured["detectors"]["gaussian"]["mean_ms"] < measured["kernels"]["octomap"]["mean_ms"]
    assert measured["kernels"]["octomap"]["mean_ms"] > measured["kernels"]["pid"]["mean_ms"]
