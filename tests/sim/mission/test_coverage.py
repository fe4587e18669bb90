from __future__ import annotations

import numpy as np
import pytest

from services.models.world import Box, BoxWorld
from sim.mission.coverage import RASTER_M, clearances, survey
from sim.world import World, definition, make_world

WALL = (-0.5, -50.0, 0.0, 0.5, 2.0, 20.0)
REST_OF_WALL = (-0.5, 8.0, 0.0, 0.5, 50.0, 20.0)


def world(*boxes: Box) -> World:
    return make_world(BoxWorld(name="test", kind="boxes", boxes=boxes), 0)


def test_figures_of_a_wall_with_a_doorway_worked_out_by_hand() -> None:
    """A doorway of 6 m in a wall of 1 m through an area of 100 m by 100 m."""
    figures = survey(world(WALL, REST_OF_WALL))
    assert figures.widest_way_m == pytest.approx(3.0, abs=RASTER_M)
    assert figures.free_space == pytest.approx(1 - 0.01 * 0.94, abs=0.001)
    # The wall reaches into the cells on either side of x = 0, and its doorway leaves a part of each.
    assert figures.density == pytest.approx(0.2)
    assert figures.start_clearance_m == pytest.approx(24.5, abs=RASTER_M)
    assert figures.obstacles == 2


def test_a_closed_wall_leaves_no_way() -> None:
    assert survey(world(WALL, (-0.5, 2.0, 0.0, 0.5, 50.0, 20.0))).widest_way_m == 0.0


def test_what_does_not_reach_the_flight_height_is_in_nobodys_way() -> None:
    low = (-0.5, -50.0, 0.0, 0.5, 50.0, 1.0)
    assert survey(world(low, (40.0, 40.0, 0.0, 41.0, 41.0, 20.0))).widest_way_m > 10.0


def test_clearance_is_the_distance_to_the_nearest_box() -> None:
    found = clearances(
        world((0.0, 0.0, 0.0, 2.0, 2.0, 9.0)), np.array([-3.0, 1.0, 5.0]), np.array([1.0, 6.0])
    )
    assert found == pytest.approx(np.array([[3.0, 5.0], [0.0, 4.0], [3.0, 5.0]]))


@pytest.mark.parametrize("name", ["factory", "farm"])
def test_the_hand_made_worlds_have_a_way_for_the_pilots_clearance(name: str) -> None:
    """The planner keeps 2.25 m from an occupied voxel's centre."""
    assert survey(make_world(name, 0)).widest_way_m > 2.75


def test_the_farm_is_nearly_free_and_the_factory_has_no_way_round() -> None:
    farm, factory = survey(make_world("farm", 0)), survey(make_world("factory", 0))
    assert farm.room_to_fly > 0.9
    given = definition("factory")
    assert isinstance(given, BoxWorld)
    bricked_up = [*given.boxes, (7.5, -16.0, 0.0, 8.5, -8.0, 20.0), (7.5, 2.0, 0.0, 8.5, 10.0, 20.0)]
    closed = given.model_copy(update={"boxes": tuple(bricked_up)})
    assert survey(make_world(closed, 0)).widest_way_m == 0.0 < factory.widest_way_m
