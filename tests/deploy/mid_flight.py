"""Do something to a flight while it flies: in its middle by virtual time, however fast the machine is."""

import os
import threading
from collections.abc import Callable
from contextlib import suppress

import pytest

from deploy.mission.flight import FlownMission, fly
from deploy.mission.fork_server import ForkServer
from deploy.recording.recorder import FlightRecorder
from injector.tracing import ptrace
from services.models.mission import MissionSpec
from tests.conftest import node, wait_until

NOWHERE = 16
"""An address where nothing is mapped."""

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


def fly_and_crash(server: ForkServer, spec: MissionSpec, name: str) -> FlownMission:
    """Fly and have a node crash by its own doing on the way; if the flight is over first, then again."""

    def crash() -> None:
        pid = node(os.getpid(), name)
        if pid is not None:
            jump_to_nowhere(pid)

    for _ in range(5):
        flight = fly_and(server, spec, crash)
        if flight.outcome.nodes[name].crashes:
            return flight
    pytest.fail("five flights were over before the crash")


def jump_to_nowhere(pid: int) -> None:
    """Have a process go on at an address where nothing is."""
    with suppress(ProcessLookupError):
        ptrace.seize(pid)
        ptrace.interrupt(pid)
        ptrace.await_report(pid)
        ptrace.go_to(pid, NOWHERE)
        ptrace.detach(pid)


def fly_and_kill(server: ForkServer, spec: MissionSpec, name: str, number: int) -> None:
    """Fly and have a process of a name be sent a signal on the way; if the flight is over first, then again.

    :raises Exception: what the flight failed with.
    """
    killed: list[int] = []

    def kill() -> None:
        pid = node(os.getpid(), name)
        if pid is not None:
            with suppress(ProcessLookupError):
                os.kill(pid, number)
                killed.append(pid)

    for _ in range(5):
        fly_and(server, spec, kill)
        if killed:
            return
    pytest.fail("five flights were over before the signal")
