"""How long kernels take in virtual time (seeded jitter above a hard lower bound), and messages on a link."""

from __future__ import annotations

import numpy as np

from services.bus.topics import OVER_LINK, TICK_NS
from services.models.equipment import Link
from services.models.platform import KernelLatency
from services.runtime.rng import generator

_BLOCK = 256
_SLOW = 2.0
"""Only one draw in twenty is farther than these many standard deviations above the mean: exp(-3)."""


class Latency:
    """The latencies of one kernel in one flight.

    The draw of an invocation is keyed by (``seed``, ``kernel``, ``life``, invocation), so it is the same
    in a flight and in its golden twin; draws are made ahead, block by block. Whole nanoseconds: ``least_ns``
    is never gone below, ``slow_ns`` exceeded by one call in twenty.
    """

    def __init__(self, stated: KernelLatency, seed: int, kernel: str, life: int) -> None:
        mean_ns = stated.mean_ms * 1e6
        self._spread_ns = mean_ns * stated.jitter
        self.least_ns = round(mean_ns - self._spread_ns)
        self.slow_ns = round(mean_ns + _SLOW * self._spread_ns)
        self._key = seed, f"latency {kernel}", life
        self._block = -1
        self._draws: list[int] = []

    def of(self, invocation: int) -> int:
        """The latency of this invocation in nanoseconds; never less than ``least_ns``."""
        if not self._spread_ns:
            return self.least_ns
        block, place = divmod(invocation, _BLOCK)
        if block != self._block:
            extra = generator(*self._key, block).exponential(self._spread_ns, _BLOCK)
            self._draws = (self.least_ns + np.rint(extra).astype(np.int64)).tolist()
            self._block = block
        return self._draws[place]


class VirtualLink:
    """What a mission's link does to the messages of its topics; the draws follow from the seed alone."""

    def __init__(self, link: Link, seed: int) -> None:
        self._link = link
        self._seed = seed

    def least_ns(self, topic: str) -> int:
        """How long a message of the topic is under way at least."""
        return self._link.delay_ns if topic in OVER_LINK else 0

    def arrival_ns(self, topic: str, sent_ns: int) -> int | None:
        """When a message that is sent at ``sent_ns`` comes; None if it is lost.

        Those of a topic in one tick share their fate, so that a flight and its golden twin lose the same
        ones, though a fault may move a command within its tick.
        """
        if topic not in OVER_LINK:
            return sent_ns
        loss = self._link.loss
        if loss and generator(self._seed, f"link {topic}", sent_ns // TICK_NS).random() < loss:
            return None
        return sent_ns + self._link.delay_ns
