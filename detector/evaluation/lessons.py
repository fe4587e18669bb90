"""Saves what a model was trained on as one small file, so that it can be trained again without flights."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detector.schemes.base import Lesson


def save_lessons(path: Path, lessons: Sequence[Lesson]) -> None:
    """Write the lessons, array by array end to end, with their lengths."""
    arrays: dict[str, NDArray[Any]] = {}
    for name in lessons[0]:
        parts = [np.atleast_1d(lesson[name]) for lesson in lessons]
        arrays[name] = np.concatenate(parts)
        arrays[f"{name}/lengths"] = np.array([len(part) for part in parts])
    with path.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
