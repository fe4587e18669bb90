"""Reads the lessons that ``zenfi train --lessons FILE`` has saved."""

import zipfile
from pathlib import Path

import numpy as np

from detector.schemes.base import Lesson
from detector.series.series import BadSeriesError


def load_lessons(path: Path) -> list[Lesson]:
    """The lessons in a file, flight by flight.

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
