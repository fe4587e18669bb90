"""A flight as a detector sees it: every check that its stages would have asked for, in order."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detector.errors import DetectionInputError
from detector.series.monitored_states import WATCHED
from services.models.mission import MissionSpec

Floats = NDArray[np.float64]


class BadSeriesError(DetectionInputError):
    """A file that is no recorded flight: one line that names it."""


@dataclass(frozen=True, slots=True)
class Checks:
    """The checks of one stage in one flight.

    ``values`` (rows, columns as ``WATCHED`` names them), ``first`` (n,) the row at which each check
    begins, ``times_s`` (n,) when it was asked, virtual time.
    """

    values: Floats
    first: NDArray[np.int64]
    times_s: Floats

    def __len__(self) -> int:
        return len(self.first)

    def empty(self, check: int) -> bool:
        """Whether a check has no row: a trajectory that says that there is no way."""
        rows = self.rows(check)
        return bool(rows.start == rows.stop)

    def rows(self, check: int) -> slice:
        """The slice of ``values`` that holds the rows of a check."""
        end = self.first[check + 1] if check + 1 < len(self.first) else len(self.values)
        return slice(int(self.first[check]), int(end))


@dataclass(frozen=True, slots=True)
class Series:
    """The checks of a flight by stage, with what is known of the flight.

    ``about``: ``spec`` (the mission as asked for), ``result``, ``digest``, ``time_s`` flown, and for an
    injected flight ``injected_s``, the virtual time of its fault, and ``sdc``, whether its messages
    differ from the golden twin's.
    """

    checks: Mapping[str, Checks]
    about: Mapping[str, Any]

    @property
    def spec(self) -> MissionSpec:
        """The specification of the mission that was flown."""
        return MissionSpec.model_validate(self.about["spec"])

    def save(self, path: Path) -> None:
        """Write the flight as an npz file."""
        arrays: dict[str, NDArray[Any]] = {"about": np.array(json.dumps(self.about))}
        for stage, checks in self.checks.items():
            arrays |= {
                f"{stage}.values": checks.values,
                f"{stage}.first": checks.first,
                f"{stage}.times_s": checks.times_s,
            }
        part = path.with_suffix(".part")
        with part.open("wb") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
        part.replace(path)  # who is interrupted leaves no half of a flight


def load_series(path: Path) -> Series:
    """Read a recorded flight from an npz file.

    :raises BadSeriesError: if the file is no recorded flight of the states that are watched now.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            about = json.loads(str(stored["about"]))
            MissionSpec.model_validate(about["spec"])
            checks = {
                stage: Checks(
                    stored[f"{stage}.values"].astype(np.float64),
                    stored[f"{stage}.first"].astype(np.int64),
                    stored[f"{stage}.times_s"].astype(np.float64),
                )
                for stage in WATCHED
            }
    except (OSError, KeyError, ValueError, TypeError, EOFError, zipfile.BadZipFile) as error:
        message = f"{path}: not a recorded flight ({error}); make it by zenfi train record"
        raise BadSeriesError(message) from error
    for stage, columns in WATCHED.items():
        if checks[stage].values.ndim != 2 or checks[stage].values.shape[1] != len(columns):
            message = f"{path}: {stage} was recorded with other states; record it again"
            raise BadSeriesError(message)
    return Series(checks, about)


def load_folder(folder: Path) -> list[Series]:
    """Every flight in a folder, in the order of their names.

    :raises BadSeriesError: if there is none, or one is none.
    """
    paths = sorted(folder.glob("*.npz"))
    if not paths:
        message = f"{folder}: holds no recorded flight; make some by zenfi train record --output {folder}"
        raise BadSeriesError(message)
    return [load_series(path) for path in paths]
