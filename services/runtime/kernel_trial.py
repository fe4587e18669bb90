"""A kernel alone, on an input that was recorded in flight: what a stage offers for each of its kernels."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.bus.horizon import Stamped
from services.bus.messages import decode
from services.bus.topics import TOPICS
from services.models.mission import MissionSpec

Sample = Mapping[str, NDArray[Any]]
"""A recorded input: arrays by name; messages are their CDR bytes (uint8)."""

Messages = Mapping[str, Sequence[Stamped]]
"""The messages of a flight by topic."""


class KernelOutput(NamedTuple):
    """What a kernel made: every bit of it, and the numbers that matter, in SI units."""

    image: bytes
    values: NDArray[np.float64]


class KernelTrial(ABC):
    """One call of a kernel, its state made anew from the sample."""

    @abstractmethod
    def run(self) -> None:
        """Call the kernel, once; nothing else happens here."""

    @abstractmethod
    def values(self) -> NDArray[Any]:
        """The numbers that matter of what the call made."""

    def image(self) -> bytes:
        """Every bit of what the call made: of the values, if that is all."""
        values = self.values()
        return repr(values.shape).encode() + values.tobytes()

    def output(self) -> KernelOutput:
        """All that the call made: its image and its values."""
        return KernelOutput(self.image(), np.asarray(self.values(), dtype=np.float64))


class SampleFlight(NamedTuple):
    """A flight to take samples from."""

    spec: MissionSpec
    messages: Messages


class NoSampleError(Exception):
    """The flight holds no input that puts the kernels to work."""


def cdr(message: Stamped) -> NDArray[np.uint8]:
    """A message's bytes as an array of a sample."""
    return np.frombuffer(message.payload, dtype=np.uint8)


def decoded(topic: str, payload: NDArray[np.uint8]) -> Any:
    """The message in such an array; its own arrays are read-only views, as those from the bus are."""
    return decode(payload.tobytes(), TOPICS[topic].type)
