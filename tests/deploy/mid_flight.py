"""Do something to a flight while it flies: in its middle by virtual time, however fast the machine is."""

import os
import signal
import threading
from collections.abc import Callable

import pytest

from deploy.mission.flight import FlownMission, fly
from deploy.mission.fork_server import ForkServer
from deploy.recording.recorder import FlightRecorder
from services.models.mission import MissionSpec
from tests.conftest import node, wait_until

FLOWN_NS = 2_000_000_000
"""Of virtual time: a plan is made and flown; no mission of the tests is over by then."""


def fly_and(server: ForkServer, spec: MissionSpec, meanwhile: Callable[[], None]) -> FlownMission:
    """Fly, and do something once a good part is flown.

    :raises Exception: what the flight failed with.
    """
    recorders: list[FlightRecorder] = []
    flights: list[FlownMission | Exception] = []

    def fly_it() -> None:
        try:
            flights.append(fly(spec, server, watch=lambda _, recorder: recorders.append(recorder)))
        except Exception as error:  # noqa: BLE001 - raised where it is asked for
            flights.append(error)

    def flying() -> bool:
        newest = recorders[0].last("odometry") if recorders else None
        return not thread.is_alive() or (newest is not None and newest.ready_ns >= FLOWN_NS)

    thread = threading.Thread(target=fly_it)
    thread.start()
    try:
        wait_until(flying)
        meanwhile()
    finally:
        thread.join()
    flight = flights[0]
    if isinstance(flight, Exception):
        raise flight
    return flight


def fly_and_kill(server: ForkServer, spec: MissionSpec, name: str) -> FlownMission:
    """Fly and kill a node on the way; on a busy machine the flight may be over first, then again."""

    def kill() -> None:
        pid = node(os.getpid(), name)
        if pid is not None:
            os.kill(pid, signal.SIGKILL)

    for _ in range(5):
        flight = fly_and(server, spec, kill)
        if flight.outcome.nodes[name].crashes:
            return flight
    pytest.fail("five flights were over before the kill arrived")
