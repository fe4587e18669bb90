"""An environment of its own in a scratch folder, in which packages can be installed beside ours."""

import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

ROOT = Path(__file__).parents[1]
PLUG_INS = ROOT / "docs" / "plug_ins.md"
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


def install_examples(folder: Path) -> None:
    """Install the package of ``docs/plug_ins.md`` in an environment of a folder, as the page says."""
    shutil.copytree(ROOT / "docs" / "plug_ins", folder / "docs" / "plug_ins")
    make_environment(folder, ROOT)
    (what,) = re.findall(r"^\$ pip install (.*)$", PLUG_INS.read_text(), re.MULTILINE)
    install(folder, what)


def zenfi(folder: Path, arguments: str) -> subprocess.CompletedProcess[str]:
    """The command in the environment of a folder."""
    return subprocess.run(
        [".venv/bin/python", "-c", "from dashboard.cli import main; main()", *shlex.split(arguments)],
        cwd=folder,
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
        check=False,
    )
