"""Counts what the guards of a mission do in a node, where its supervisor reads it."""

from __future__ import annotations

from collections.abc import MutableMapping

import numpy as np

from services.bus.message_checks import RefusedMessageError
from services.bus.messages import MalformedMessageError
from services.models.pilots import GuardName, Guards, numbered


class GuardCounts:
    """The counts of one node, on its page of shared memory; guards that other packages add come last."""

    def __init__(self, page: np.void, active: Guards) -> None:
        self._page = page
        self._numbers = {name: number for number, name in enumerate(numbered(active))}

    def take(self, acted: MutableMapping[GuardName, int]) -> None:
        """Add how often guards acted, and empty ``acted``."""
        while acted:
            guard, times = acted.popitem()
            self._page["guards"][self._numbers[guard]] += times

    def refused(self, error: MalformedMessageError) -> None:
        """Count a message that was refused: by a check, or because it is no message of its type."""
        self._page["malformed"] += 1
        if isinstance(error, RefusedMessageError):
            self._page["guards"][self._numbers[error.check]] += 1
