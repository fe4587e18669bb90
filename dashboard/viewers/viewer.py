"""The programs that show a recording, and how each is started."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from types import MappingProxyType

from dashboard.viewers import blueprint
from deploy.errors import BadSpecError, InfrastructureError


@dataclass(frozen=True, slots=True)
class Viewer:
    """One program: how to get it, and how it shows a recording; ``show`` returns when it is closed."""

    program: str
    remedy: str
    show: Callable[[str, Path], None]

    @property
    def found(self) -> str | None:
        """The path of the installed viewer."""
        return shutil.which(self.program)


def choose(name: str | None) -> Viewer:
    """The viewer of that name; without one the first that is installed.

    :raises BadSpecError: saying what to install.
    """
    for known, viewer in VIEWERS.items():
        if viewer.found and name in (None, known):
            return viewer
    wanted = VIEWERS if name is None else {name: VIEWERS[name]}
    remedies = "; ".join(f"{known}: {viewer.remedy}" for known, viewer in wanted.items())
    message = f"no viewer is installed: {remedies}" if name is None else f"not installed: {remedies}"
    raise BadSpecError(message)


def _rerun(program: str, recording: Path) -> None:
    """Rerun reads MCAP; what to show where it takes from a blueprint of the same application."""
    with tempfile.TemporaryDirectory(prefix="zenfi-view-") as folder:
        converted, shown = Path(folder) / f"{recording.stem}.rrd", []
        _run(program, "mcap", "convert", str(recording), "-o", str(converted), *_CONVERT)
        if importlib.util.find_spec("rerun") is not None:
            blueprint.save(Path(folder) / "zenfi.rbl")
            shown.append(str(Path(folder) / "zenfi.rbl"))
        _run(program, str(converted), *shown)


def _plotjuggler(program: str, recording: Path) -> None:
    with as_file(files("dashboard.viewers") / "plotjuggler.xml") as layout:
        _run(program, "--nosplash", "--datafile", str(recording), "--layout", str(layout))


def _foxglove(program: str, recording: Path) -> None:
    """Foxglove takes no layout from the command line: it has to be imported, once."""
    with as_file(files("dashboard.viewers") / "foxglove.json") as layout:
        print(f"a layout to import, once: {layout}", file=sys.stderr)  # noqa: T201 - for the user
        _run(program, str(recording))


_CONVERT = ("--application-id", blueprint.APPLICATION, "--timeline-type", "duration", "--recover")

VIEWERS: Mapping[str, Viewer] = MappingProxyType(
    {
        "rerun": Viewer("rerun", "pip install 'zenfi[rerun]'", _rerun),
        "plotjuggler": Viewer("plotjuggler", "https://plotjuggler.io (snap, apt, AppImage)", _plotjuggler),
        "foxglove": Viewer("foxglove-studio", "https://foxglove.dev/download", _foxglove),
    }
)
"""In the order in which one is looked for."""


def _run(*command: str) -> None:
    status = subprocess.run(command, check=False).returncode  # noqa: S603 - a program that the user installed
    if status:
        message = f"{command[0]} ended with status {status}"
        raise InfrastructureError(message)
