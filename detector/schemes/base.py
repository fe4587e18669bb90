"""The interface of detection schemes. Schemes are plug-ins: entry points of ``zenfi.detectors``.

A stage asks before it publishes: ``check(stage, values)`` answers an alarm or None. The answer depends
only on what that stage asked before. What passed is the predecessor of the next check; what was alarmed is
neither that nor learned from. After a recovery, or when an alarm has been overruled, the stage calls
``reset``: then nothing has a predecessor.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from detector.series.series import Series

Floats = NDArray[np.float64]
Lesson = Mapping[str, NDArray[Any]]
"""What a scheme learns from one flight, by name: all of it together must fit into memory and a small file."""

LIMIT = 1.0
"""The score above which a check is an alarm."""


@dataclass(frozen=True, slots=True)
class Alarm:
    """A check that failed: which state, in which row of the check, and how far beyond what is allowed.

    ``score`` is the distance from the normal in units of the largest one allowed, so it is above 1.
    """

    stage: str
    state: str
    row: int
    score: float


class Scheme(ABC):
    """One detector with its model; of one flight, as it remembers what was asked."""

    name: ClassVar[str]

    @abstractmethod
    def check(self, stage: str, values: Floats) -> Alarm | None:
        """Judge the monitored ``values`` (rows, columns of ``WATCHED[stage]``), C-contiguous float64."""

    @abstractmethod
    def score(self, stage: str, values: Floats) -> float:
        """The score that :meth:`check` would find; nothing is remembered or learned."""

    @abstractmethod
    def reset(self, stage: str) -> None:
        """Forget what a stage asked before; what was learned stays."""

    @classmethod
    @abstractmethod
    def lesson(cls, flight: Series) -> Lesson:
        """Extract what the scheme learns from an error-free flight."""

    @classmethod
    @abstractmethod
    def train(cls, lessons: Sequence[Lesson], seed: int) -> dict[str, Any]:
        """The parameters learned: what :meth:`load` takes, as JSON can hold it.

        The same lessons and seed give the same parameters.
        """

    @classmethod
    @abstractmethod
    def load(cls, parameters: Mapping[str, Any], *, learning: bool = True) -> Self:
        """A detector for one flight; ``learning``: it goes on learning in flight, if the scheme does.

        :raises ValueError: if these are no parameters of this scheme (pydantic's error is one).
        """
