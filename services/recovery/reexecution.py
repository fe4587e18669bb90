"""Re-execution: a copy of the stage makes each output first; where the stage makes another one, one is wrong.

The copy is a fork of the stage. It has the same memory and the same input, runs the same kernels and ends; no
fault strikes it. Digests of all that both publish are compared, so every bit counts. It cannot see a wrong
input, which both have, memory that was struck before, nor, on a real computer, a fault that stays.

Stages repeat bit for bit, so where the mission's fault cannot strike the two are the same, and no copy is
made: a fork takes more time than most outputs. Virtual time is not touched by that.
"""

from __future__ import annotations

import hashlib
import mmap
import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Protocol, TypeVar

from services.bus.proxy_link import Digest
from services.system.process_copies import IN_THE_COPY, fork_and_wait

SCHEME = "reexecution"
"""The name under which a mission asks for it."""

DIGEST_BYTES = 16

Made = TypeVar("Made")


class Reach(Protocol):
    """What re-execution needs to know of the mission's fault."""

    @property
    def strikes(self) -> int:
        """How often the fault was let at the stage."""
        ...

    def covers_next(self, now_ns: int) -> bool:
        """Whether the fault may strike the output that the stage makes next."""
        ...


class RepeatableStage(Protocol):
    """What re-execution needs of the node that it belongs to."""

    now_ns: int

    @property
    def fault_reach(self) -> Reach:
        """What the mission's fault can strike of the node."""
        ...

    def overheard(self, digest: Digest, *, in_a_copy: bool) -> AbstractContextManager[None]:
        """Have a digest of all that is published in the body of a ``with`` statement.

        In a copy it goes nowhere else, nothing is counted or asked for, and no fault strikes.
        """
        ...


class Reexecution:
    """Makes each output of a stage twice.

    ``differed``: whether the two of the last output did; ``took_ns``, the virtual time that one of them took.
    """

    def __init__(self, stage: RepeatableStage) -> None:
        self._stage = stage
        self._seen = mmap.mmap(-1, DIGEST_BYTES)  # both see it
        self.differed = False
        self.took_ns = 0

    def make(self, make: Callable[[], Made], sent: Callable[[Made], bytes]) -> Made:
        """What ``make`` makes, after a copy has made it; ``sent`` is what of it is published."""
        if not self._stage.fault_reach.covers_next(self._stage.now_ns):
            return self._make_alone(make, sent)
        self._seen[:] = bytes(DIGEST_BYTES)
        forked = fork_and_wait()
        if forked == IN_THE_COPY:
            try:
                self._seen[:] = self._make(make, sent, in_a_copy=True)[1]
            finally:
                os._exit(0)
        if forked < 0:
            raise OSError(-forked, os.strerror(-forked))
        begun_ns = self._stage.now_ns
        made, seen = self._make(make, sent, in_a_copy=False)
        self.took_ns = self._stage.now_ns - begun_ns
        self.differed = seen != self._seen[:]
        return made

    def _make_alone(self, make: Callable[[], Made], sent: Callable[[Made], bytes]) -> Made:
        """What ``make`` makes, of which a copy would make the same.

        :raises RuntimeError: if a fault was let at it all the same.
        """
        begun_ns, strikes = self._stage.now_ns, self._stage.fault_reach.strikes
        made, _ = self._make(make, sent, in_a_copy=False)
        if self._stage.fault_reach.strikes != strikes:
            raise RuntimeError("a fault was let at an output of which there is no copy")
        self.took_ns, self.differed = self._stage.now_ns - begun_ns, False
        return made

    def _make(
        self, make: Callable[[], Made], sent: Callable[[Made], bytes], *, in_a_copy: bool
    ) -> tuple[Made, bytes]:
        heard = hashlib.blake2b(digest_size=DIGEST_BYTES)
        with self._stage.overheard(heard, in_a_copy=in_a_copy):
            made = make()
        heard.update(sent(made))
        return made, heard.digest()
