"""Re-execution, as far as a detector has part in it: none. Stages compare what they make twice by themselves.

See :mod:`services.recovery.reexecution`. A mission asks for it as for any scheme.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Self

import numpy as np

from detector.schemes.base import Alarm, Floats, Lesson, Scheme
from detector.series.series import Series
from services.recovery.reexecution import SCHEME


class ComparedByStages(Scheme):
    """A scheme that finds nothing: what stages make twice, they compare before anybody is asked."""

    name: ClassVar[str] = SCHEME

    def check(self, stage: str, values: Floats) -> Alarm | None:  # noqa: ARG002
        """No alarm: the stage has compared by itself."""
        return None

    def score(self, stage: str, values: Floats) -> float:  # noqa: ARG002
        """Nothing is seen in values alone."""
        return 0.0

    def reset(self, stage: str) -> None:
        """Do nothing, for nothing is remembered."""

    @classmethod
    def lesson(cls, flight: Series) -> Lesson:  # noqa: ARG003
        """One empty lesson, for nothing is learned."""
        return {"nothing": np.empty(0)}

    @classmethod
    def train(cls, lessons: Sequence[Lesson], seed: int) -> dict[str, Any]:  # noqa: ARG003
        """No parameters, for nothing is learned."""
        return {}

    @classmethod
    def load(cls, parameters: Mapping[str, Any], *, learning: bool = True) -> Self:  # noqa: ARG003
        """Make a scheme, for which there are no parameters.

        :raises ValueError: if there are some.
        """
        if parameters:
            message = "re-execution has no parameters"
            raise ValueError(message)
        return cls()
