"""Counts what the guards of a mission do in a node, where its supervisor reads it."""

from __future__ import annotations

from collections.abc import MutableMapping

import numpy as np

from services.bus.message_checks import RefusedMessageError
from services.bus.messages import MalformedMessageError
from services.models.pilots import GUARDS, GuardName

_NUMBERS = {name: number for number, name in enumerate(GUARDS)}


class GuardCounts:
    """The counts of one node, on its page of shared memory."""

    def __init__(self, page: np.void) -> None:
        self._page = page

    def take(self, acted: MutableMapping[GuardName, int]) -> None:
        """Add how often guards acted, and empty ``acted``."""
        while acted:
            guard, times = acted.popitem()
            self._page["guards"][_NUMBERS[guard]] += times

    def refused(self, error: MalformedMessageError) -> None:
        """Count a message that was refused: by a check, or because it is no message of its type."""
        self._page["malformed"] += 1
        if isinstance(error, RefusedMessageError):
            self._page["guards"][_NUMBERS[error.check]] += 1
