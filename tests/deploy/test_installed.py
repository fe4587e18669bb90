"""ZenFI as pip installs it: a wheel, in the site-packages in which all that it needs lies too."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import venv
from pathlib import Path
from zipfile import ZipFile

import pytest

from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PACKAGES = [name.rstrip("*") for name in PROJECT["tool"]["setuptools"]["packages"]["find"]["include"]]
PIP = ("-m", "pip", "--disable-pip-version-check", "--quiet")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from a copy: a build leaves files beside what it builds."""
    copy, wheels = tmp_path_factory.mktemp("copy"), tmp_path_factory.mktemp("wheels")
    for file in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / file, copy)
    for name in PACKAGES:
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    build = ("wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", wheels, copy)
    subprocess.run([sys.executable, *PIP, *build], check=True)
    (built,) = wheels.iterdir()
    return built


@pytest.fixture(scope="module")
def environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A new environment with the wheel, and with links to what this one has but for ZenFI."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, symlinks=True)
    packages = site_packages(folder)
    for entry in Path(sysconfig.get_path("purelib")).iterdir():
        if entry.name not in (*PACKAGES, "__pycache__") and not entry.name.startswith(
            ("__editable__", "zenfi-")
        ):
            (packages / entry.name).symlink_to(entry)
    install = ("install", "--no-deps", "--no-index", "--no-compile", wheel)
    subprocess.run([folder / "bin" / "python", *PIP, *install], check=True)
    # As packages do that were made for older versions of Python.
    (packages / "dataclasses.py").write_text("raise ImportError('this is not the standard library')\n")
    return folder


def site_packages(environment: Path) -> Path:
    return Path(sysconfig.get_path("purelib", "venv", {"base": str(environment)}))


def test_the_wheel_holds_every_file_of_the_product(wheel: Path) -> None:
    packed = {name for name in ZipFile(wheel).namelist() if ".dist-info/" not in name}
    files = (file for name in PACKAGES for file in (ROOT / name).rglob("*") if file.is_file())
    assert packed == {str(file.relative_to(ROOT)) for file in files if "__pycache__" not in file.parts}


@pytest.mark.soak
def test_a_flight_from_the_wheel_is_that_from_the_checkout(
    environment: Path, server: ForkServer, tmp_path: Path
) -> None:
    spec = MissionSpec(world="sparse", seed=7, fault=FaultSpec(target="octomap", seed=3))
    here = PairFlyer(server).fly(spec)
    assert here.injection is not None
    assert here.golden is not None
    surroundings = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def answer(*command: str) -> str:
        program = environment / "bin" / command[0]
        return subprocess.run(
            [program, *command[1:]],
            cwd=tmp_path,
            env=surroundings,
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        ).stdout

    where = answer("python", "-c", "import services, sim; print(services.__file__, sim.__file__)").split()
    assert all(Path(file).is_relative_to(site_packages(environment)) for file in where)
    fault = ("--fault", "instruction:octomap", "--fault-seed", "3")
    there = json.loads(answer("zenfi", "fly", "--world", "sparse", "--seed", "7", *fault, "--json"))
    assert here.golden.result == there["golden"]["result"] == "success"
    assert here.golden.digest == there["golden"]["digest"]

    # Memory lies elsewhere in another installation; where a fault strikes and what comes of it do not change.
    for name in ("module", "build_id", "offset", "register", "bits"):
        assert there["injection"][name] == here.injection.model_dump(by_alias=True)[name]
    assert there["digest"] == here.digest
    (tmp_path / "flight.json").write_text(here.model_dump_json(by_alias=True))
    told = json.loads(answer("zenfi", "replay", "flight.json", "--json"))
    assert told["answer"] in ("replayed", "relocated")
