"""An environment of its own in a scratch folder, in which packages can be installed beside ours."""

import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

INSTALL = ("pip", "--python", ".venv/bin/python", "install", "-q", "--no-deps", "--no-build-isolation")


def make_environment(folder: Path, *modules_from: Path) -> Path:
    """Make ``.venv`` in a folder, that has the packages of this one, and ``modules_from`` other folders.

    Answers where packages are installed in it.
    """
    venv.create(folder / ".venv")
    packages = next((folder / ".venv" / "lib").iterdir()) / "site-packages"
    lines = (sysconfig.get_path("purelib"), *map(str, modules_from))
    (packages / "ours.pth").write_text("\n".join((*lines, "")))
    return packages


def install(folder: Path, *what: str) -> None:
    """Install packages in the environment of a folder, from the files that are there."""
    subprocess.run([sys.executable, "-m", *INSTALL, *what], cwd=folder, check=True, stdin=subprocess.DEVNULL)
