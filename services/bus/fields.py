"""The fields of a message, flat: ``pose.pose.position.x`` and its value."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from typing import Any

import numpy as np


def flat(message: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Name and value of every field in order: numbers, strings, arrays, and lists of messages as they are."""
    for field in fields(message):
        if field.name == "__msgtype__":
            continue  # of types that were read from a file
        name, value = f"{prefix}{field.name}", getattr(message, field.name)
        if hasattr(value, "__msgtype__"):
            yield from flat(value, f"{name}.")
        else:
            yield name, value


def same(one: Any, other: Any) -> bool:
    """Whether two values of a field are the same to the bit: a NaN is itself, and 0.0 is not -0.0."""
    if isinstance(one, float | np.ndarray):
        first, second = np.asarray(one), np.asarray(other)
        return first.shape == second.shape and first.tobytes() == second.tobytes()
    return bool(one == other)
