"""A worker: flies the missions it reads, one JSON line in, one JSON line out.

One slot of a campaign is one worker with a fork server of its own, held on one processor: neighbours
on the bus then wake each other without crossing processors, and slots do not disturb each other.
A line in is an :class:`~deploy.order.Order`, a line out an :class:`~deploy.answer.Answer`. One that is
watched tells a few times a second how its flight stands.
"""

from __future__ import annotations

import argparse
import os
import sys
import threading

from deploy.answer import ALIVE, Answer
from deploy.forkserver import ForkServer, ForkServerError
from deploy.order import Order
from deploy.pairing import NothingToInjectError, Pairs
from deploy.present import Present, present
from deploy.processors import claim
from deploy.recorder import Recorder
from deploy.sight import SIGHTS_PER_S, Sight, sight
from deploy.supervisor import InfrastructureError
from services.bus.lifeline import die_with_parent
from services.bus.mission import MissionSpec

HEARTBEAT_S = 2.0
WATCHED_S = 0.25
"""Between two lines of a worker that is watched."""

LAST_BREATH_S = 1.0
"""Wall time in which the end of a fork server is noticed by which a flight has failed."""


class _Window:
    """Looks into the flight that is under way."""

    def __init__(self) -> None:
        self._twin = False
        self._flight: tuple[MissionSpec, Recorder] | None = None
        self._looks = 0

    def begin(self, spec: MissionSpec) -> None:
        """A line has come: what is flown without its fault is the twin."""
        self._twin = spec.fault is not None

    def watch(self, spec: MissionSpec, recorder: Recorder) -> None:
        """A flight has begun."""
        self._flight = spec, recorder

    def end(self) -> None:
        """Nothing is flown."""
        self._flight = None

    def look(self) -> Present | None:
        """How the flight stands."""
        flight = self._flight
        if flight is None:
            return None
        spec, recorder = flight
        return present(recorder, twin=self._twin and spec.fault is None)

    def see(self) -> Sight | None:
        """What the flight sees, at most :data:`SIGHTS_PER_S` times a second; None in between."""
        flight = self._flight
        self._looks += 1
        if flight is None or self._looks % round(1 / (SIGHTS_PER_S * WATCHED_S)):
            return None
        return sight(flight[1])


def main() -> None:
    """Entry point: ``python -m deploy.worker [CPU] [--watched]``; ends when its input does.

    Without a processor it takes one that is free.
    """
    die_with_parent()
    options = argparse.ArgumentParser()
    options.add_argument("cpu", type=int, nargs="?")
    options.add_argument("--watched", action="store_true")
    asked = options.parse_args()
    claimed = claim() if asked.cpu is None else None
    cpu = claimed[0] if claimed is not None else asked.cpu
    if cpu is not None:
        os.sched_setaffinity(0, {cpu})
    window = _Window()
    ended = threading.Event()
    heart = threading.Thread(target=_beat, args=(ended, window if asked.watched else None), daemon=True)
    # Before the fork server, which compiles for minutes where nothing has flown yet.
    heart.start()
    server = ForkServer()
    pairs = Pairs(server, window.watch)
    try:
        for line in sys.stdin:
            order = Order.model_validate_json(line)
            window.begin(order.spec)
            answer = _fly(pairs, order)
            window.end()
            if answer.error and server.is_lost(LAST_BREATH_S):
                # No result: the run is taken back from who dies, and another worker has another server.
                sys.exit(f"the fork server was lost: {answer.error}")
            _say(answer.model_dump_json(by_alias=True))
    finally:
        ended.set()
        heart.join()
        server.close()


_mouth = threading.RLock()


def _say(line: str) -> None:
    with _mouth:
        sys.stdout.write(line + "\n")
        sys.stdout.flush()


def _beat(ended: threading.Event, window: _Window | None) -> None:
    while not ended.wait(HEARTBEAT_S if window is None else WATCHED_S):
        with _mouth:  # how a flight stands is not told after its answer
            _say(_seen(window) if window is not None else ALIVE)


def _seen(window: _Window) -> str:
    return Answer(alive=True, present=window.look(), sight=window.see()).model_dump_json()


def _fly(pairs: Pairs, order: Order) -> Answer:
    try:
        return Answer(outcome=pairs.fly(order.spec, order.record, order.about, order.live))
    except (InfrastructureError, ForkServerError, NothingToInjectError) as error:
        return Answer(error=f"{type(error).__name__}: {error}")


if __name__ == "__main__":
    main()
