"""Stack files read and checked, before anything is started."""

from __future__ import annotations

from pathlib import Path

from pydantic import ValidationError

from deploy.compose.stack_file import Bus, Stack
from deploy.config.definitions import read_toml
from deploy.errors import BadSpecError, one_line

DEFAULT = Path(__file__).parents[1] / "stacks" / "laboratory.toml"
"""What a laboratory needs; ``zenfi up`` with nothing said. Its processes work where ``zenfi`` was called."""


FOXGLOVE = DEFAULT.with_name("foxglove.toml")
"""What shows its flights live."""


def read_stack(file: Path | None, *, foxglove: bool = False) -> Stack:
    """The stack in a TOML file (None: the one that comes along), its paths made absolute.

    Relative paths in a file begin at the file's folder. With ``foxglove`` it also has the process that shows
    flights live.

    :raises BadSpecError: naming the file, the field and the remedy.
    """
    given = read_toml(str(file or DEFAULT))
    if foxglove:
        more = read_toml(str(FOXGLOVE))["processes"]
        given = {**given, "processes": {**more, **given.get("processes", {})}}
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
    bus = stack.bus.model_copy(update={field: str(base / path) for field, path in _files(stack.bus)})
    return stack.model_copy(update={"processes": processes, "logs": logs, "bus": bus})


def _files(bus: Bus) -> list[tuple[str, str]]:
    fields = ("root_ca_certificate", "certificate", "private_key")
    return [(field, path) for field in fields if (path := getattr(bus, field)) is not None]
