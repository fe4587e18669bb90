"""Definitions of one's own: worlds, airframes and platforms read from TOML files into a specification."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from deploy.check import BadSpecError, one_line
from services.bus.mission import MissionSpec

_DEFINED = ("world", "airframe", "platform")


def read_toml(path: str) -> dict[str, Any]:
    """The tables of a TOML file.

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
    """``fields`` of a mission with the content of a file where one is named.

    A flight then depends on its specification alone, wherever that is read again.

    :raises BadSpecError: naming the file, if it cannot be read or is malformed.
    """
    return {
        name: _content(name, value)
        if name in _DEFINED and isinstance(value, str) and value.endswith(".toml")
        else value
        for name, value in fields.items()
    }


def _content(field: str, path: str) -> Any:
    """What a file says, checked on its own so that a mistake is told with the file's name."""
    given = read_toml(path)
    try:
        MissionSpec.model_validate({field: given})
    except ValidationError as error:
        message = f"{path}: {one_line(error)}"
        raise BadSpecError(message) from error
    return given
