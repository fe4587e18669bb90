"""One real flight of each mission type, and what a fault and a death do to them."""

import pytest

from deploy.mission.flight import fly
from deploy.mission.fork_server import ForkServer
from services.kernels import GOAL_KERNELS
from services.models.mission import MissionSpec
from services.models.outcome import Outcome

# A quarter of the default area: the flights are as short as they are telling.
SMALL = {"lower": (-25.0, -7.0), "upper": (0.0, 5.0)}


def flown(server: ForkServer, **fields: object) -> Outcome:
    return fly(MissionSpec.model_validate({"seed": 7, **fields}), server).outcome


OVER_AN_AREA = ("scanning", "mapping", "search")


@pytest.fixture(scope="module")
def over_an_area(server: ForkServer) -> dict[str, Outcome]:
    """A flight of each mission."""
    return {mission: flown(server, mission=mission, area=SMALL) for mission in OVER_AN_AREA}


@pytest.mark.parametrize("mission", OVER_AN_AREA)
def test_a_mission_over_an_area_succeeds_by_its_own_kernel(
    mission: str, over_an_area: dict[str, Outcome]
) -> None:
    outcome = over_an_area[mission]
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


def test_a_mission_repeats(over_an_area: dict[str, Outcome], server: ForkServer) -> None:
    again = flown(server, mission="mapping", area=SMALL)
    assert over_an_area["mapping"].digest == again.digest != over_an_area["search"].digest


@pytest.mark.soak
def test_a_flight_with_prm_star_arrives_and_repeats(server: ForkServer) -> None:
    first, second = (flown(server, planner="prm_star") for _ in range(2))
    assert first.result == "success"
    assert first.digest == second.digest
