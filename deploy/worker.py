"""A worker: flies the missions it reads, one JSON line in, one JSON line out.

One slot of a campaign is one worker with a fork server of its own, held on one processor: neighbours
on the bus then wake each other without crossing processors, and slots do not disturb each other.
A line in is a :class:`MissionSpec`; a line out is ``{"outcome": ...}`` or ``{"error": ...}``, and every
few seconds ``{"alive": true}``, so that a worker that was stopped is told from one that is busy.
"""

from __future__ import annotations

import json
import os
import sys
import threading

from deploy.forkserver import ForkServer, ForkServerError
from deploy.pairing import NothingToInjectError, Pairs
from deploy.supervisor import InfrastructureError
from services.bus.lifeline import die_with_parent
from services.bus.mission import MissionSpec

HEARTBEAT_S = 2.0


def main() -> None:
    """Entry point: ``python -m deploy.worker [CPU]``; ends when its standard input does."""
    die_with_parent()
    cpu = int(sys.argv[1]) if len(sys.argv) > 1 else None
    if cpu is not None:
        os.sched_setaffinity(0, {cpu})
    server = ForkServer()
    pairs = Pairs(server)
    ended = threading.Event()
    heart = threading.Thread(target=_beat, args=(ended,), daemon=True)
    heart.start()
    try:
        for line in sys.stdin:
            _say(_fly(pairs, line))
    finally:
        ended.set()
        heart.join()
        server.close()


_mouth = threading.Lock()


def _say(line: str) -> None:
    with _mouth:
        sys.stdout.write(line + "\n")
        sys.stdout.flush()


def _beat(ended: threading.Event) -> None:
    while not ended.wait(HEARTBEAT_S):
        _say(json.dumps({"alive": True}))


def _fly(pairs: Pairs, line: str) -> str:
    spec = MissionSpec.model_validate_json(line)
    try:
        outcome = pairs.fly(spec)
    except (InfrastructureError, ForkServerError, NothingToInjectError) as error:
        return json.dumps({"error": f"{type(error).__name__}: {error}"})
    return json.dumps({"outcome": outcome.model_dump(mode="json", by_alias=True)})


if __name__ == "__main__":
    main()
