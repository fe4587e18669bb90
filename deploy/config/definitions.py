"""Definitions of one's own: worlds, airframes and more, read from TOML files into a specification."""

from __future__ import annotations

import shutil
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from deploy.config.check import digest_of
from deploy.errors import BadSpecError, one_line
from detector.schemes.model_files import read_model
from detector.schemes.registry import load_detector
from services.models.faults.mask_histogram import MaskHistogram
from services.models.mission import MissionSpec
from sim.world import BadWorldError, definition

_LONGEST_FIRST_LINE = 256
_DEFINED = ("world", "airframe", "platform")


def read_toml(path: str) -> dict[str, Any]:
    """Read the tables of a TOML file.

    :raises BadSpecError: naming the file, if it cannot be read or is malformed.
    """
    try:
        return tomllib.loads(Path(path).read_text())
    except OSError as error:
        message = f"{path}: {error.strerror}"
        raise BadSpecError(message) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        message = f"{path}: not valid TOML: {error}"
        raise BadSpecError(message) from error


def inlined(fields: Mapping[str, Any]) -> dict[str, Any]:
    """``fields`` of a mission, its ``fault`` among them, with the content of a file where one is named.

    A flight then depends on its specification alone, wherever that is read again.

    :raises BadSpecError: naming the file, if it cannot be read or is malformed.
    :raises DetectionInputError: the same of a detector's model.
    """
    return {name: _inlined(name, value) for name, value in fields.items()}


def _inlined(field: str, value: Any) -> Any:
    if field in _DEFINED and isinstance(value, str) and value.endswith(".toml"):
        return _content(field, value)
    if field == "world" and isinstance(value, str) and "," in value:
        return world_with(value)
    if field == "stack" and isinstance(value, str):
        return own_stack(Path(value))
    if field == "fault" and isinstance(value, dict) and isinstance(value.get("histogram"), str):
        return {**value, "histogram": _histogram(value["histogram"])}
    if field == "detector" and isinstance(value, dict) and isinstance(value.get("model"), str):
        path = Path(value["model"])
        # Loaded as in flight, so that an error names the file.
        load_detector(str(value.get("scheme")), path)
        return {**value, "model": read_model(path).model_dump()}
    return value


def _histogram(path: str) -> dict[str, Any]:
    given = read_toml(path)
    try:
        MaskHistogram.model_validate(given)
    except ValidationError as error:
        message = f"{path}: {one_line(error)}"
        raise BadSpecError(message) from error
    return given


def world_with(text: str) -> dict[str, Any]:
    """The definition of a world that comes along with other parameters: ``NAME,FIELD=NUMBER[,...]``.

    Its name tells them apart: ``forest,difficulty=0.8`` is called ``forest-0.8``, other parameters with
    their names.

    :raises BadSpecError: if there is no such world or parameter.
    """
    name, *settings = text.split(",")
    try:
        fields = definition(name).model_dump(exclude_unset=True)
    except BadWorldError as error:
        raise BadSpecError(str(error)) from error
    for setting in settings:
        parameter, _, number = setting.partition("=")
        try:
            fields[parameter] = tomllib.loads(f"number = {number}")["number"]
        except tomllib.TOMLDecodeError as error:
            message = f"world {text!r}: {setting!r} is not FIELD=NUMBER, as in forest,difficulty=0.8"
            raise BadSpecError(message) from error
        if not isinstance(fields[parameter], int | float):
            message = f"world {text!r}: {parameter} is to be a number; write a file for anything else"
            raise BadSpecError(message)
        name += f"-{number}" if parameter == "difficulty" else f"-{parameter}-{number}"
    fields["name"] = name
    return _checked("world", text, fields)


def own_stack(file: Path) -> dict[str, Any]:
    """The own stack in a file: paths from its folder on, with the executables' digests.

    :raises BadSpecError: naming the file, if it is malformed or an executable is none.
    """
    given = read_toml(str(file))
    stages = given.get("stages")
    programs = [*(stages.values() if isinstance(stages, dict) else ()), given.get("autopilot")]
    for program in programs:
        words = program.get("command") if isinstance(program, dict) else None
        if not (isinstance(words, list) and words and all(isinstance(word, str) for word in words)):
            continue  # reported below
        folder = (file.parent / str(program.get("folder", "."))).resolve()
        command = [*_program(folder, words[0]), *words[1:]]
        program.update(folder=str(folder), command=command, sha256=digest_of(command, folder))
    return _checked("stack", str(file), given)


def _program(folder: Path, name: str) -> list[str]:
    """What a command names: a path from a folder on, or a program in PATH; of a script, its interpreter, too.

    Links are not followed: an interpreter knows by its path which packages are its own.
    """
    found = str(folder / name) if "/" in name else shutil.which(name)
    if found is None:
        message = f"stack: there is no program {name!r} in PATH"
        raise BadSpecError(message)
    try:
        with Path(found).open("rb") as file:
            first = file.readline(_LONGEST_FIRST_LINE)
    except OSError as error:
        message = f"stack: {found}: {error.strerror}"
        raise BadSpecError(message) from error
    interpreter = first[2:].decode(errors="replace").split() if first.startswith(b"#!") else []
    return [*interpreter, found]


def _content(field: str, path: str) -> Any:
    """The content of a file, checked on its own so that an error names the file."""
    return _checked(field, path, read_toml(path))


def _checked(field: str, path: str, given: dict[str, Any]) -> dict[str, Any]:
    try:
        MissionSpec.model_validate({field: given})
    except ValidationError as error:
        message = f"{path}: {one_line(error)}"
        raise BadSpecError(message) from error
    return given
