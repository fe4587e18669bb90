"""Build a release: source archive, wheel and bill of materials, by ``python3 launch.py release``."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

from release.bill_of_materials import bill_of_materials
from release.dependencies import ROOT, Dependencies

FOLDER = ROOT / "build" / "release"


def build(checkout: Path, folder: Path) -> list[Path]:
    """Build the release of a checkout into a folder, which is emptied before; the files.

    The wheel is built from the source archive, so that the archive is known to be whole.
    """
    shutil.rmtree(folder, ignore_errors=True)
    command = ("-P", "-m", "build", "--no-isolation", "--outdir", str(folder), str(checkout))
    subprocess.run([sys.executable, *command], check=True, stdout=subprocess.DEVNULL)
    (wheel,) = folder.glob("*.whl")
    name = "-".join(wheel.name.split("-")[:2])
    (folder / f"{name}.cdx.json").write_text(bill_of_materials(Dependencies.ours(), wheel))
    return sorted(folder.iterdir())


def main() -> int:
    """Build into ``build/release`` and name the files; status 1 if dependencies are not as they must be."""
    dependencies = Dependencies.ours()
    unlocked = [
        f"{one}: not the lock's version: launch.py --locked release" for one in dependencies.unlocked()
    ]
    if wrong := dependencies.complaints() + unlocked:
        sys.stderr.write("".join(f"{one}\n" for one in wrong))
        return 1
    for file in build(ROOT, FOLDER):
        sys.stdout.write(f"{file.relative_to(ROOT)}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
