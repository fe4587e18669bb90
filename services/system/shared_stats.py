"""Counters of a node in a page of memory shared with its supervisor; they outlive the node.

The page outlives the node, so the supervisor can read at which virtual time a node crashed and whether
it still computes. It carries nothing that influences a flight.
"""

from __future__ import annotations

import mmap
import os
from typing import Any

import numpy as np

MAX_KERNELS = 16
MAX_GUARDS = 16

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
    ("guards", np.int64, (MAX_GUARDS,)),  # what each did, in the order of their table
]
_LAYOUT = np.dtype(
    [
        *_COUNTS,
        ("before", np.dtype([("step_ns", np.int64), *_COUNTS]), (STEPS_KEPT,)),
        ("step_ns", np.int64),  # virtual time of the step under way or last finished
        ("computing", np.int64),  # 1 within a step, 0 while waiting
        ("gated", np.int64),  # 1 while it waits at the injector's gate
        ("program", np.int64),  # pid of the program that computes in the node's place, 0 for none
        ("asking", np.int64),  # 1 while it waits for the detector's verdict
        ("compute_wall_ns", np.int64),
        ("messaging_wall_ns", np.int64),
        ("waiting_wall_ns", np.int64),
        ("invocations", np.int64, (MAX_KERNELS,)),  # by the order of the node's kernel names
        ("end_ns", np.int64, (MAX_KERNELS,)),  # virtual time at which the last call ends
        ("cpu_ns", np.int64, (MAX_KERNELS,)),
        ("cpu_squares_ns2", np.float64, (MAX_KERNELS,)),
        ("last_cpu_ns", np.int64, (MAX_KERNELS,)),
        # What follows is the proxy's: it depends on when things come, so no node may look at it.
        ("late", np.int64),  # ticks begun more than a tick late, in real time
        ("recovered", np.int64),  # messages fetched again from the recorder
        ("unreadable", np.int64),  # messages refused because they are of no form
        ("doubled", np.int64),  # messages refused because they are here already
    ]
)


class SharedStats:
    """One node's page. The supervisor creates it, node and proxy map the same file descriptor."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        self._map = mmap.mmap(descriptor, _LAYOUT.itemsize)
        self._record = np.frombuffer(self._map, dtype=_LAYOUT)
        self.page: np.void = self._record[0]

    @classmethod
    def create(cls, name: str) -> SharedStats:
        """A new page in anonymous memory, gone with its last owner."""
        descriptor = os.memfd_create(f"zenfi-{name}", os.MFD_CLOEXEC)
        os.ftruncate(descriptor, _LAYOUT.itemsize)
        return cls(descriptor)

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
        later = [one for one in self.page["before"] if one["step_ns"] >= end_ns]
        found: np.void = min(later, key=lambda one: (one["step_ns"], one["steps"]), default=self.page)
        return found.copy()

    def close(self) -> None:
        """Unmap the page and close its descriptor."""
        del self.page
        del self._record
        self._map.close()
        os.close(self.descriptor)
