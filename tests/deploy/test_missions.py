"""One real flight of each mission type, and what a fault and a death do to them."""

import pytest

from deploy.forkserver import ForkServer
from deploy.mission import fly
from services.bus.mission import MissionSpec
from services.bus.outcome import Outcome
from services.kernels import GOAL_KERNELS

# A quarter of the default area: the flights are as short as they are telling.
SMALL = {"lower": (-25.0, -7.0), "upper": (0.0, 5.0)}


def flown(server: ForkServer, **fields: object) -> Outcome:
    return fly(MissionSpec.model_validate({"seed": 7, **fields}), server).outcome


@pytest.mark.parametrize("mission", ["scanning", "mapping", "search"])
def test_a_mission_over_an_area_succeeds_by_its_own_kernel(mission: str, server: ForkServer) -> None:
    outcome = flown(server, mission=mission, area=SMALL)
    assert outcome.result == "success"
    assert {"lawn_mower", "frontier"} & set(outcome.nodes["planning"].kernels) == {GOAL_KERNELS[mission]}
    assert outcome.topics["task"].messages == 1
    assert outcome.qof.coverage is not None
    assert outcome.qof.coverage >= (0.9 if mission != "search" else 0.05)
    assert outcome.qof.flight_time_s > 5.0


def test_a_delivery_flies_there_and_back_and_needs_no_kernel_for_that(server: ForkServer) -> None:
    delivery, navigation = flown(server, mission="delivery"), flown(server)
    assert delivery.result == navigation.result == "success"
    assert delivery.qof.distance_m > 1.8 * navigation.qof.distance_m
    assert delivery.qof.coverage is None
    assert navigation.topics["task"].messages == 0


def test_a_mission_repeats(server: ForkServer) -> None:
    first, second = (flown(server, mission="mapping", area=SMALL) for _ in range(2))
    assert first.digest == second.digest
    assert first.digest != flown(server, mission="search", area=SMALL).digest


def test_a_flight_with_prm_star_arrives_and_repeats(server: ForkServer) -> None:
    first, second = (flown(server, planner="prm_star") for _ in range(2))
    assert first.result == "success"
    assert first.digest == second.digest
