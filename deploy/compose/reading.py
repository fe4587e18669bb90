"""Stack files read and checked, before anything is started."""

from __future__ import annotations

from pathlib import Path

from pydantic import ValidationError

from deploy.compose.stack_file import Stack
from deploy.config.definitions import read_toml
from deploy.config.link_security import AUTHORITY, CERTIFICATE, KEY
from deploy.errors import BadSpecError, one_line

DEFAULT = Path(__file__).parents[1] / "stacks" / "laboratory.toml"
"""What a laboratory needs; ``zenfi up`` with nothing said. Its processes work where ``zenfi`` was called."""


FOXGLOVE = DEFAULT.with_name("foxglove.toml")
"""What shows its flights live."""


def read_stack(file: Path | None, *, foxglove: bool = False, tls: Path | None = None) -> Stack:
    """The stack in a TOML file (None: the one that comes along), its paths made absolute.

    Relative paths in a file begin at the file's folder. With ``foxglove`` it also has the process that shows
    flights live; ``tls`` is the folder of certificates in place of the file's.

    :raises BadSpecError: naming the file, the field and the remedy.
    """
    given = read_toml(str(file or DEFAULT))
    if foxglove:
        more = read_toml(str(FOXGLOVE))["processes"]
        given = {**given, "processes": {**more, **given.get("processes", {})}}
    if tls is not None and isinstance(given.get("bus", {}), dict):
        given = {**given, "bus": {**given.get("bus", {}), "tls": str(tls.resolve())}}
    try:
        stack = Stack.model_validate(given)
    except ValidationError as error:
        message = f"{file or DEFAULT}: {one_line(error)}"
        raise BadSpecError(message) from error
    return _absolute(stack, (file.parent if file else Path()).resolve(), file or DEFAULT)


def _absolute(stack: Stack, base: Path, file: Path) -> Stack:
    processes = {}
    for name, process in stack.processes.items():
        folder = base / process.folder
        if not folder.is_dir():
            message = f"{file}: processes.{name}.folder: {folder} is not a folder"
            raise BadSpecError(message)
        processes[name] = process.model_copy(update={"folder": str(folder)})
    logs = str(base / stack.logs) if stack.logs else None
    bus = stack.bus
    if bus.tls is not None:
        bus = bus.model_copy(update={"tls": str(base / bus.tls)})
        _check_certificates(Path(str(bus.tls)), f"{file}: bus.tls")
    return stack.model_copy(update={"processes": processes, "logs": logs, "bus": bus})


def _check_certificates(folder: Path, named: str) -> None:
    """Check what Zenoh would only find out in the background, and tell nobody.

    :raises BadSpecError: if a file is missing, or others may read the key.
    """
    for name in (AUTHORITY, CERTIFICATE, KEY):
        if not (folder / name).is_file():
            message = f"{named}: {folder} has no {name}: zenfi certificates makes such folders"
            raise BadSpecError(message)
    if (folder / KEY).stat().st_mode & 0o077:
        message = f"{named}: {folder / KEY} can be read by others: chmod 600 {folder / KEY}"
        raise BadSpecError(message)
