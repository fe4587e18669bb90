"""Outcomes of flights that stand for others, by a name of their class: in memory, and in a shared folder.

A file is there whole or not at all. What cannot be read or written is flown again.
"""

from __future__ import annotations

import os
from collections import OrderedDict
from contextlib import suppress
from pathlib import Path

from pydantic import ValidationError

from services.models.outcome import Outcome

IN_MEMORY = 2000
"""Outcomes that one process remembers, some 20 kB each."""

IN_FOLDER = 20_000
"""Files, some 10 kB each, of which the oldest is removed when a process takes the folder."""


class FlownOutcomes:
    """Remembers outcomes by name; with a folder, those of all processes that have the same one."""

    def __init__(self) -> None:
        self._folder: Path | None = None
        self._known: OrderedDict[str, Outcome] = OrderedDict()

    def share(self, folder: Path | None) -> None:
        """Find and keep outcomes in a folder as well; None: in memory alone."""
        if folder == self._folder:
            return
        self._folder = folder
        if folder is not None:
            with suppress(OSError):
                folder.mkdir(mode=0o700, exist_ok=True)
                files = sorted(folder.glob("*.json"), key=lambda one: -one.stat().st_mtime)
                for old in files[IN_FOLDER:]:
                    old.unlink()

    def find(self, name: str) -> Outcome | None:
        """The outcome of that name, None if it is not known."""
        found = self._known.get(name)
        if found is None and self._folder is not None:
            with suppress(OSError, ValidationError):
                found = Outcome.model_validate_json((self._folder / f"{name}.json").read_bytes())
                self._remember(name, found)
        return found

    def keep(self, name: str, outcome: Outcome) -> None:
        """Remember an outcome by the name of its class."""
        self._remember(name, outcome)
        if self._folder is not None:
            with suppress(OSError):  # no room: whoever wants it flies it again
                unfinished = self._folder / f"{name}.{os.getpid()}"
                unfinished.write_text(outcome.model_dump_json(by_alias=True))
                unfinished.replace(self._folder / f"{name}.json")

    def _remember(self, name: str, outcome: Outcome) -> None:
        self._known[name] = outcome
        if len(self._known) > IN_MEMORY:
            self._known.popitem(last=False)
