"""ZenFI as pip installs it: a wheel in an environment of its own, used outside the checkout."""

import os
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import venv
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PACKAGES = [name.rstrip("*") for name in PROJECT["tool"]["setuptools"]["packages"]["find"]["include"]]
PIP = ("-m", "pip", "--disable-pip-version-check", "--quiet")


@dataclass(frozen=True)
class Installed:
    """An environment with the wheel, and a folder in which its commands are given."""

    environment: Path
    folder: Path

    @property
    def packages(self) -> Path:
        """Its site-packages."""
        return next((self.environment / "lib").glob("python3.*")) / "site-packages"

    @property
    def surroundings(self) -> dict[str, str]:
        """The environment variables of its commands: none leads to the checkout or to the user's store."""
        kept = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        return {**kept, "ZENFI_HOME": str(self.folder / "home")}

    def start(self, *command: object, output: int = subprocess.DEVNULL) -> subprocess.Popen[str]:
        """Start a command of the environment; what it prints goes to ``output``."""
        program, *arguments = map(str, command)
        return subprocess.Popen(
            [str(self.environment / "bin" / program), *arguments],
            cwd=self.folder,
            env=self.surroundings,
            stdin=subprocess.DEVNULL,
            stdout=output,
            text=True,
        )

    def answer(self, *command: object) -> str:
        """What a command prints; it must succeed."""
        process = self.start(*command, output=subprocess.PIPE)
        output, _ = process.communicate()
        assert process.returncode == 0, f"{command}: status {process.returncode}\n{output}"
        return output


def build_wheel(copy: Path, wheels: Path) -> Path:
    """The wheel, built from a copy: a build leaves files beside what it builds."""
    for file in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / file, copy)
    for name in PACKAGES:
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    build = ("wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", wheels, copy)
    subprocess.run([sys.executable, *PIP, *build], check=True)
    (built,) = wheels.iterdir()
    return built


def link_and_install(wheel: Path, installed: Installed) -> None:
    """Install the wheel beside links to all that this environment has but for ZenFI."""
    venv.create(installed.environment, symlinks=True)
    packages = installed.packages
    for entry in Path(sysconfig.get_path("purelib")).iterdir():
        if entry.name not in (*PACKAGES, "__pycache__") and not entry.name.startswith(
            ("__editable__", "zenfi-")
        ):
            (packages / entry.name).symlink_to(entry)
    installed.answer("python", *PIP, "install", "--no-deps", "--no-index", "--no-compile", wheel)
    # As packages do that were made for older versions of Python.
    (packages / "dataclasses.py").write_text("raise ImportError('this is not the standard library')\n")


def download_and_install(wheel: Path, version: str, installed: Installed) -> None:
    """Install the wheel with Python ``version``, and what it needs from the package index; nothing else."""
    subprocess.run([interpreter(version), "-m", "venv", installed.environment], check=True)
    installed.answer("python", *PIP, "install", wheel)


def interpreter(version: str) -> str:
    """A Python of that version on this machine; without one the test is skipped."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    named = f"python{version}"
    for candidate in (shutil.which(named), *pyenv.glob(f"{version}.*/bin/{named}")):
        # A launcher of pyenv's is there for each version that it has, also if none is chosen.
        works = (
            candidate is not None
            and subprocess.run([candidate, "-c", ""], check=False, stderr=subprocess.DEVNULL).returncode == 0
        )
        if works:
            return str(candidate)
    pytest.skip(f"there is no Python {version} here")
