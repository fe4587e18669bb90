"""Lessons as one small file: enough to train again without flying again."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detector.scheme import Lesson
from detector.series import BadSeriesError


def save_lessons(path: Path, lessons: Sequence[Lesson]) -> None:
    """Write the lessons, array by array end to end, with their lengths."""
    arrays: dict[str, NDArray[Any]] = {}
    for name in lessons[0]:
        parts = [np.atleast_1d(lesson[name]) for lesson in lessons]
        arrays[name] = np.concatenate(parts)
        arrays[f"{name}/lengths"] = np.array([len(part) for part in parts])
    with path.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def load_lessons(path: Path) -> list[Lesson]:
    """Read lessons back.

    :raises BadSeriesError: if the file holds none.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        names = [name for name in arrays if not name.endswith("/lengths")]
        ends = {name: np.cumsum(arrays[f"{name}/lengths"])[:-1] for name in names}
    except (OSError, KeyError, ValueError, TypeError, EOFError, zipfile.BadZipFile) as error:
        message = f"{path}: holds no lessons ({error})"
        raise BadSeriesError(message) from error
    parts = {name: np.split(arrays[name], ends[name]) for name in names}
    return [dict(zip(parts, rows, strict=True)) for rows in zip(*parts.values(), strict=True)]
