"""A worker: flies the missions it reads, one JSON line in, one JSON line out.

One slot of a campaign is one worker with a fork server of its own, held on one processor: neighbours
on the bus then wake each other without crossing processors, and slots do not disturb each other.
A line in is an :class:`~deploy.workers.protocol.WorkerOrder`, a line out an
:class:`~deploy.workers.protocol.WorkerAnswer`. One that is watched sends the status of its flight
a few times a second.
"""

from __future__ import annotations

import argparse
import os
import sys
import threading

from deploy.errors import DisturbedFlightError, InfrastructureError
from deploy.mission.fork_server import ForkServer, ForkServerError
from deploy.pairing.golden_twin import NothingToInjectError, PairFlyer
from deploy.recording.flight_status import FlightStatus, current_status
from deploy.recording.recorder import FlightRecorder
from deploy.recording.snapshot import SNAPSHOTS_PER_S, FlightSnapshot, current_snapshot
from deploy.workers.cpu_claim import claim
from deploy.workers.protocol import ALIVE, WorkerAnswer, WorkerOrder
from services.models.mission import MissionSpec
from services.system.lifeline import die_with_parent

HEARTBEAT_S = 2.0
WATCHED_S = 0.25
"""Between two lines of a worker that is watched."""

LAST_BREATH_S = 1.0
"""Wall time in which the end of a fork server is noticed by which a flight has failed."""


class _Window:
    """Reads the status of the flight that is under way."""

    def __init__(self) -> None:
        self._twin = False
        self._flight: tuple[MissionSpec, FlightRecorder] | None = None
        self._looks = 0

    def begin(self, spec: MissionSpec) -> None:
        """Note a new order: a flight without its fault is then the golden twin."""
        self._twin = spec.fault is not None

    def watch(self, spec: MissionSpec, recorder: FlightRecorder) -> None:
        """Note that a flight has begun."""
        self._flight = spec, recorder

    def end(self) -> None:
        """Note that no flight is under way."""
        self._flight = None

    def look(self) -> FlightStatus | None:
        """The status of the flight, or None between flights."""
        flight = self._flight
        if flight is None:
            return None
        spec, recorder = flight
        return current_status(recorder, twin=self._twin and spec.fault is None)

    def see(self) -> FlightSnapshot | None:
        """The flight's snapshot, at most :data:`SNAPSHOTS_PER_S` times a second; None in between."""
        flight = self._flight
        self._looks += 1
        if flight is None or self._looks % round(1 / (SNAPSHOTS_PER_S * WATCHED_S)):
            return None
        return current_snapshot(flight[1])


def main() -> None:
    """Entry point: ``python -m deploy.workers.worker [CPU] [--watched]``; ends when its input does.

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
    pairs = PairFlyer(server, window.watch)
    try:
        for line in sys.stdin:
            order = WorkerOrder.model_validate_json(line)
            window.begin(order.spec)
            answer = _fly(pairs, order)
            window.end()
            if answer.error and server.is_lost(LAST_BREATH_S):
                # No result: the run is taken back from who dies, and another worker has another server.
                sys.exit(f"the fork server was lost: {answer.error}")
            _report(answer.model_dump_json(by_alias=True))
    finally:
        ended.set()
        heart.join()
        server.close()


_output = threading.RLock()


def _report(line: str) -> None:
    with _output:
        sys.stdout.write(line + "\n")
        sys.stdout.flush()


def _beat(ended: threading.Event, window: _Window | None) -> None:
    while not ended.wait(HEARTBEAT_S if window is None else WATCHED_S):
        with _output:  # no status of a flight follows its answer
            _report(_seen(window) if window is not None else ALIVE)


def _seen(window: _Window) -> str:
    return WorkerAnswer(alive=True, present=window.look(), sight=window.see()).model_dump_json()


def _fly(pairs: PairFlyer, order: WorkerOrder) -> WorkerAnswer:
    pairs.proofs.flown.share(order.flown)
    try:
        return WorkerAnswer(outcome=pairs.fly(order.spec, order.record, order.about, order.live, order.ahead))
    except DisturbedFlightError as error:
        return WorkerAnswer(error=str(error), disturbed=True)
    except (InfrastructureError, ForkServerError, NothingToInjectError) as error:
        return WorkerAnswer(error=f"{type(error).__name__}: {error}")


if __name__ == "__main__":
    main()
