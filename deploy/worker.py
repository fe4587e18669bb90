"""A worker: flies the missions it reads, one JSON line in, one JSON line out.

One slot of a campaign is one worker with a fork server of its own, held on one processor: neighbours
on the bus then wake each other without crossing processors, and slots do not disturb each other.
A line in is a :class:`MissionSpec`; a line out is ``{"outcome": ...}`` or ``{"error": ...}``.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import sys

from deploy.forkserver import PR_SET_PDEATHSIG, ForkServer, ForkServerError
from deploy.pairing import NothingToInjectError, Pairs
from deploy.supervisor import InfrastructureError
from services.bus.mission import MissionSpec


def main() -> None:
    """Entry point: ``python -m deploy.worker [CPU]``; ends when its standard input does."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    cpu = int(sys.argv[1]) if len(sys.argv) > 1 else None
    if cpu is not None:
        os.sched_setaffinity(0, {cpu})
    server = ForkServer()
    pairs = Pairs(server)
    try:
        for line in sys.stdin:
            sys.stdout.write(_fly(pairs, line) + "\n")
            sys.stdout.flush()
    finally:
        server.close()


def _fly(pairs: Pairs, line: str) -> str:
    spec = MissionSpec.model_validate_json(line)
    try:
        outcome = pairs.fly(spec)
    except (InfrastructureError, ForkServerError, NothingToInjectError) as error:
        return json.dumps({"error": f"{type(error).__name__}: {error}"})
    return json.dumps({"outcome": outcome.model_dump(mode="json", by_alias=True)})


if __name__ == "__main__":
    main()
