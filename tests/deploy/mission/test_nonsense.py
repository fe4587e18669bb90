"""A stage that talks nonsense on a real bus: nobody crashes, no command leaves its limits, all is counted."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from deploy.config.processes import STACK
from deploy.errors import DisturbedFlightError
from deploy.mission.flight import fly
from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from services.bus.horizon import Stamped
from services.bus.messages import decode
from services.bus.topics import TOPICS
from services.control.pid import YAW_RATE_LIMIT_RAD_S
from services.models.mission import Limits, MissionSpec
from services.models.safety import SPEED_LIMIT_M_S

SPEC = MissionSpec(world="dense", seed=2, limits=Limits(mission_time_s=15.0))


def commands(messages: Sequence[Stamped]) -> NDArray[np.float64]:
    twists = [decode(message.payload, TOPICS["command"].type).twist for message in messages]
    return np.array([[t.linear.x, t.linear.y, t.linear.z, t.angular.z] for t in twists])


@pytest.mark.soak
@pytest.mark.parametrize(
    ("talker", "listeners"),
    [
        ("sim", ("perception", "planning", "control")),
        ("perception", ("planning", "control")),
        ("planning", ("perception", "control")),
    ],
)
def test_nonsense_crashes_nobody_and_never_reaches_the_command(
    talker: str, listeners: tuple[str, ...]
) -> None:
    server = ForkServer({**STACK, talker: replace(STACK[talker], module="tests.fixtures.nodes.nonsense")})
    try:
        flight = fly(SPEC, server, keep_messages=True)
    finally:
        server.close()
    outcome = flight.outcome
    assert {name: report.causes for name, report in outcome.nodes.items() if report.causes} == {}
    for listener in listeners:
        assert outcome.nodes[listener].malformed > 0, listener
        assert outcome.nodes[listener].outdated > 0, listener
    assert outcome.refused_messages > 0
    assert flight.messages is not None
    flown = commands(flight.messages["command"])
    assert len(flown) > 100
    assert np.isfinite(flown).all()
    assert (np.hypot(flown[:, 0], flown[:, 1]) <= SPEED_LIMIT_M_S + 1e-9).all()
    assert (np.abs(flown[:, 2]) <= SPEED_LIMIT_M_S).all()
    assert (np.abs(flown[:, 3]) <= YAW_RATE_LIMIT_RAD_S).all()


def test_a_message_before_the_time_that_was_promised_ends_its_node() -> None:
    """Others may have gone on already or not, as the machine goes: such a flight would not repeat."""
    early = replace(STACK["control"], module="tests.fixtures.nodes.early")
    server = ForkServer({**STACK, "control": early})
    try:
        with pytest.raises(DisturbedFlightError, match="control died in a flight without a fault: nonsense"):
            PairFlyer(server).fly(SPEC)
    finally:
        server.close()
