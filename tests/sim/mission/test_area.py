"""Areas: where they lie by default, what is refused, which cells count."""

from __future__ import annotations

import numpy as np
import pytest

from deploy.config.check import check
from deploy.errors import BadSpecError
from services.models.mission import Area, MissionSpec
from sim.mission.area import cells, corners
from sim.world import make_world, world_names


@pytest.mark.parametrize("name", world_names())
def test_the_default_area_holds_start_and_goal_and_is_of_moderate_size(name: str) -> None:
    world = make_world(name, 1)
    lower, upper = corners(Area(), world)
    for place in (world.start, world.goal):
        assert (lower[:2] <= place[:2]).all()
        assert (place[:2] <= upper[:2]).all()
    assert (upper - lower)[:2].min() >= 24.0
    assert (upper - lower)[:2].prod() < 2000.0
    assert lower[2] == upper[2] == world.start[2]


@pytest.mark.parametrize(
    "area",
    [
        {"lower": (10.0, 0.0), "upper": (-10.0, 5.0)},
        {"upper": (500.0, 5.0)},
        {"lower": (float("-1e9"), 0.0)},
    ],
)
def test_an_area_that_is_none_is_refused_in_one_line(area: dict[str, object]) -> None:
    spec = MissionSpec.model_validate({"mission": "scanning", "area": area})
    with pytest.raises(BadSpecError, match="area: lower") as refused:
        check(spec)
    assert "\n" not in str(refused.value)


def test_cells_inside_obstacles_do_not_count() -> None:
    area = np.array([[0.0, 0.0, 2.0], [10.0, 8.0, 2.0]])
    boxes = np.array([[2.0, 2.0, 0.0, 5.0, 4.0, 20.0], [7.0, 7.0, 0.0, 9.0, 9.0, 1.0]])
    assert len(cells(area, boxes[:0])) == 80
    assert len(cells(area, boxes)) == 80 - 6
