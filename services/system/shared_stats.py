"""Counters of a node in a page of memory shared with its supervisor; they outlive the node.

The page outlives the node, so the supervisor can read at which virtual time a node crashed and whether
it still computes. Which call a fault strikes stands here, too, and nowhere in the node's own memory: that is
the same up to the call, whichever it is. Nothing else in it influences a flight.
"""

from __future__ import annotations

import mmap
import os
from typing import Any

import numpy as np

MAX_KERNELS = 16
MAX_GUARDS = 16

ACTIVITIES = ("computing", "messaging", "waiting", "other")
COMPUTING, MESSAGING, WAITING, OTHER = range(len(ACTIVITIES))
"""What a node spends wall time with."""

STEPS_KEPT = 4
"""Of so many steps the page has the counts from before them: a node may be some ahead of a flight's end."""

_COUNTS: list[tuple[Any, ...]] = [
    ("steps", np.int64),
    ("dropped", np.int64),  # triggers superseded while busy
    ("malformed", np.int64),  # messages refused because they make no sense
    ("outdated", np.int64),  # messages refused because there are newer ones
    ("alarms", np.int64),  # outputs found wrong
    ("recomputed", np.int64),  # outputs made again
    ("ungated", np.int64),  # outputs without a verdict, as the detector had died
    ("lost", np.int64),  # messages lost on the mission's link
    ("guards", np.int64, (MAX_GUARDS,)),  # what each did, in the order of their table
]
NOT_ARMED = -1

_LAYOUT = np.dtype(
    [
        ("armed_invocation", np.int64),  # of the fault's kernel, NOT_ARMED for none
        ("armed_from_ns", np.int64),  # the first call from this virtual time on, NOT_ARMED for none
        *_COUNTS,
        ("before", np.dtype([("step_ns", np.int64), *_COUNTS]), (STEPS_KEPT,)),
        ("step_ns", np.int64),  # virtual time of the step under way or last finished
        ("computing", np.int64),  # 1 within a step, 0 while waiting
        ("gated", np.int64),  # 1 while it waits at the injector's gate
        ("program", np.int64),  # pid of the program that computes in the node's place, 0 for none
        ("asking", np.int64),  # 1 while it waits for the detector's verdict
        ("wall_ns", np.int64, (len(ACTIVITIES),)),
        ("invocations", np.int64, (MAX_KERNELS,)),  # by the order of the node's kernel names
        ("end_ns", np.int64, (MAX_KERNELS,)),  # virtual time at which the last call ends
        ("cpu_ns", np.int64, (MAX_KERNELS,)),
        ("cpu_squares_ns2", np.float64, (MAX_KERNELS,)),
        ("readings", np.int64, (2, 3, 2)),  # of the stopwatches of wall and processor time
        ("cpu_square_ns2", np.float64, (1,)),
        # What follows is the proxy's: it depends on when things come, so no node may look at it.
        ("late", np.int64),  # ticks begun more than a tick late, in real time
        ("recovered", np.int64),  # messages fetched again from the recorder
        ("unreadable", np.int64),  # messages refused because they are of no form
        ("doubled", np.int64),  # messages refused because they are here already
    ]
)

ARMED_INVOCATION_AT = _LAYOUT.fields["armed_invocation"][1] if _LAYOUT.fields is not None else 0
"""Where in the page the number of the armed call is, 8 bytes."""


PAGE_BYTES = _LAYOUT.itemsize


def counts_in(content: bytes, end_ns: int) -> dict[str, list[int]]:
    """What a node whose page has this content had counted before a virtual time, by name."""
    found = _counts(np.frombuffer(content, dtype=_LAYOUT)[0], end_ns)
    return {name: np.atleast_1d(found[name]).tolist() for name, *_ in _COUNTS}


def _counts(page: np.void, end_ns: int) -> np.void:
    later = [one for one in page["before"] if one["step_ns"] >= end_ns]
    found: np.void = min(later, key=lambda one: (one["step_ns"], one["steps"]), default=page)
    return found.copy()


class SharedStats:
    """One node's page. The supervisor creates it, node and proxy map the same file descriptor."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        self._map = mmap.mmap(descriptor, _LAYOUT.itemsize)
        self._record = np.frombuffer(self._map, dtype=_LAYOUT)
        self.page: np.void = self._record[0]

    @classmethod
    def create(cls, name: str) -> SharedStats:
        """A new page in anonymous memory, gone with its last owner; no call is armed."""
        descriptor = os.memfd_create(f"zenfi-{name}", os.MFD_CLOEXEC)
        os.ftruncate(descriptor, _LAYOUT.itemsize)
        created = cls(descriptor)
        created.arm(None, None)
        return created

    def arm(self, invocation: int | None, from_ns: int | None) -> None:
        """Have the node stop at the injector's gate in a call: by its number, or the first from a time on."""
        self.page["armed_invocation"] = NOT_ARMED if invocation is None else invocation
        self.page["armed_from_ns"] = NOT_ARMED if from_ns is None else from_ns

    def begin_step(self, start_ns: int) -> None:
        """Keep the counts from before the step that begins at this virtual time."""
        page = self.page
        before = page["before"][page["steps"] % STEPS_KEPT]
        for name, *_ in _COUNTS:
            before[name] = page[name]
        before["step_ns"] = start_ns

    def counts(self, end_ns: int) -> np.void:
        """What the node's steps before this virtual time have counted.

        How many steps a node makes while the flight's end is on its way to it is chance.
        """
        return _counts(self.page, end_ns)

    def content(self) -> bytes:
        """All that is in the page now."""
        return self._map[:]

    def replace(self, content: bytes) -> None:
        """Have the page hold what another one did, on another host say.

        :raises ValueError: if that is of another size.
        """
        if len(content) != PAGE_BYTES:
            message = f"a page has {PAGE_BYTES} bytes, not {len(content)}"
            raise ValueError(message)
        self._map[:] = content

    def close(self) -> None:
        """Unmap the page and close its descriptor."""
        del self.page
        del self._record
        self._map.close()
        os.close(self.descriptor)
