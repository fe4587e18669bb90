"""A proxy's ear: promises reach whoever follows a stage, by themselves or carried by a message."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from services.bus import session
from services.bus.horizon import Promise, Stamped
from services.bus.ports import Inlet, Outlet
from services.bus.session import BusAddress
from services.bus.topics import TOPICS, published_by
from services.runtime.bus_listener import BusListener
from services.system.shared_stats import SharedStats
from tests.conftest import wait_until


@pytest.fixture
def buses(tmp_path: Path) -> Iterator[tuple[zenoh.Session, zenoh.Session]]:
    """The session of the simulator's proxy, and that of another node's."""
    address = BusAddress(tmp_path, "test")
    with (
        session.open_session(address, "router", router=True),
        session.open_session(address, "sim") as sim,
        session.open_session(address, "node") as node,
    ):
        yield sim, node


def promise(odometry: int) -> Promise:
    topics = published_by("sim")
    published = tuple(odometry if topic.name == "odometry" else 0 for topic in topics)
    return Promise(1, 0, 0, (40,) * len(topics), published)


@pytest.mark.parametrize("inputs", [["odometry"], ["depth"], ["odometry", "depth"]])
def test_a_promise_that_a_message_carries_reaches_all_who_follow_the_stage(
    buses: tuple[zenoh.Session, zenoh.Session], inputs: list[str]
) -> None:
    sim, node = buses
    listener = BusListener(node, os.getpid(), SharedStats.create("node").page)
    for name in inputs:
        listener.subscribe(name, Inlet(TOPICS[name], 1, 0, 0))
    listener.follow("sim")
    outlet = Outlet(sim, "sim", TOPICS["odometry"], 0, 0)
    wait_until(lambda: "matching: true" in str(outlet._publisher.matching_status))
    outlet.put(b"pose", 0, promise(1).packed())
    listener.wait(lambda: listener.promises["sim"] is not None, when_idle=lambda: None)
    assert listener.promises["sim"] == promise(1)
    assert {one.channel.horizon_ns for one in listener.inlets.values()} == {40}
    if "odometry" in inputs:
        assert listener.inlets["odometry"].channel.head == Stamped(0, 0, b"pose")
