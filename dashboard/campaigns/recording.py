"""Which runs keep files, and how much room these may take; what is not kept is counted.

A run's files are ``run-ID.*`` in the campaign's folder of artefacts. ``run-ID.json`` is its outcome, as
``zenfi replay`` reads it, ``run-ID.mcap`` its messages.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dashboard.campaigns.spec import RecordingPolicy, Run
from dashboard.campaigns.store.database import StoreFullError
from services.models.outcome import Outcome
from services.runtime import rng

Fate = Literal["", "kept", "dropped", "over quota"]
"""Of a run's files: nobody asked for any, kept, not wanted by the policy, no room."""


@dataclass(frozen=True, slots=True)
class FileState:
    """What became of a run's files, and how large they are."""

    fate: Fate = ""
    size: int = 0


class ArtefactRecorder:
    """Keeps and drops the files of runs. ``used`` bytes were kept before."""

    def __init__(self, policy: RecordingPolicy, folder: Path, seed: int, used: int = 0) -> None:
        self._policy = policy
        self._folder = folder
        self._seed = seed
        self._used = used

    def path(self, run: int, number: int) -> Path | None:
        """Where to record a run's messages; None if the policy knows already that it does not want them."""
        if self._policy.keep == "none" or (self._policy.keep == "sample" and not self._drawn(number)):
            return None
        return self._folder / f"run-{run}.mcap"

    def file(self, planned: Mapping[int, Run], flown: Mapping[int, Outcome]) -> dict[int, FileState]:
        """Settle the files of runs that were flown.

        :raises StoreFullError: if the disk is full; what was flown is to be flown again.
        """
        if self._policy.keep == "none":
            return {}
        return {run: self._settle(run, planned[run].index, outcome) for run, outcome in flown.items()}

    def _settle(self, run: int, number: int, outcome: Outcome) -> FileState:
        if not self.wants(number, outcome):
            _remove(self._files(run))
            return FileState("dropped")
        path = self._folder / f"run-{run}.json"
        if outcome.recording is not None and outcome.recording.problem:
            message = f"{path.with_suffix('.mcap')}: {outcome.recording.problem}"
            raise StoreFullError(message)
        try:
            path.write_text(outcome.model_dump_json(by_alias=True) + "\n")
        except OSError as error:
            path.unlink(missing_ok=True)
            message = f"{path}: {error.strerror}"
            raise StoreFullError(message) from error
        files = self._files(run)
        size = sum(file.stat().st_size for file in files)
        if self._used + size > self._policy.disk_mb * 1_000_000:
            _remove(files)
            return FileState("over quota", size)
        self._used += size
        return FileState("kept", size)

    def wants(self, number: int, outcome: Outcome) -> bool:
        """Whether the policy keeps a run. Of a sample, runs of one number are kept in all cells: pairs."""
        if self._policy.keep == "sample":
            return self._drawn(number)
        return self._policy.keep == "all" or not outcome.qof.success

    def _drawn(self, number: int) -> bool:
        draw = rng.generator(self._seed, "recording sample", number)
        return bool(draw.random() < self._policy.sample)

    def _files(self, run: int) -> list[Path]:
        return list(self._folder.glob(f"run-{run}.*"))


def _remove(files: Sequence[Path]) -> None:
    for file in files:
        file.unlink(missing_ok=True)
