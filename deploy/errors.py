"""Errors that are raised and never become part of an outcome: bad input, and failures of ours."""

from __future__ import annotations

from pydantic import ValidationError


class BadSpecError(ValueError):
    """A specification that cannot be flown: one line that names the field and the remedy."""


class InfrastructureError(Exception):
    """A process, file or connection of ours has failed. The run may be flown again."""


class DisturbedFlightError(InfrastructureError):
    """A process or a file of a flight was ended or removed from outside: it is to be flown again."""


def one_line(error: ValidationError) -> str:
    """The first thing that is wrong, as ``field: what (value)``."""
    first = error.errors()[0]
    # Which form a field has and which kind of world it is goes without saying.
    where = ".".join(str(part) for part in first["loc"] if part != "definition") or "specification"
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    value = first.get("input")
    given = f", got {value!r}" if isinstance(value, (str, int, float)) else ""
    what = first["msg"].removeprefix("Value error, ")
    return f"{where}: {what}{given}{more}"
