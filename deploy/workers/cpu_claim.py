"""Claims of processors: each worker gets its own, though workers know nothing of each other."""

from __future__ import annotations

import os
import socket


def claim() -> tuple[int, socket.socket] | None:
    """A processor of ours that nobody else has claimed, with what holds the claim; None if all are taken.

    The claim is a name in the kernel's own space (unix(7), abstract), which goes when its owner does,
    whatever that one dies of.
    """
    for cpu in sorted(os.sched_getaffinity(0)):
        holder = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            holder.bind(f"\0zenfi-{os.getuid()}-processor-{cpu}")
        except OSError:
            holder.close()
        else:
            return cpu, holder
    return None
