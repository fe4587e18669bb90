"""The lawn-mower sweep covers its rectangle."""

import numpy as np
import pytest

from services.planning.sweep import lawn_mower

LOWER = np.array([-25.0, -19.0, 2.0])


@pytest.mark.parametrize(
    ("upper", "lanes"),
    [((25.0, 5.0), 3), ((25.0, 5.1), 4), ((-1.0, 31.0), 3), ((-24.5, -18.5), 1)],
)
def test_every_place_is_within_half_a_swath_of_a_lane(upper: tuple[float, float], lanes: int) -> None:
    corner = np.array([*upper, 2.0])
    ends = lawn_mower(LOWER, corner, LOWER, 8.0)
    assert len(ends) == 2 * lanes
    assert (ends >= LOWER).all()
    assert (ends <= corner).all()
    along = 0 if corner[0] - LOWER[0] >= corner[1] - LOWER[1] else 1
    sideways = np.random.default_rng(1).uniform(LOWER, corner, (200, 3))[:, 1 - along]
    assert np.abs(sideways[:, None] - ends[::2, 1 - along]).min(axis=1).max() <= 4.0
    for lane in ends.reshape(-1, 2, 3):
        assert abs(lane[1, along] - lane[0, along]) == corner[along] - LOWER[along]
        assert lane[0, 1 - along] == lane[1, 1 - along]


def test_each_lane_begins_where_the_one_before_ended() -> None:
    ends = lawn_mower(LOWER, np.array([25.0, 5.0, 2.0]), LOWER, 8.0)
    assert np.linalg.norm(ends[2::2] - ends[1:-1:2], axis=1) == pytest.approx(8.0)


@pytest.mark.parametrize("corner", [(-25.0, -19.0), (25.0, -19.0), (-25.0, 5.0), (25.0, 5.0)])
def test_it_begins_at_the_corner_nearest_to_the_start(corner: tuple[float, float]) -> None:
    start = np.array([*corner, 2.0]) * 0.9
    ends = lawn_mower(LOWER, np.array([25.0, 5.0, 2.0]), start, 8.0)
    assert ends[0, 0] == corner[0]
    assert abs(ends[0, 1] - corner[1]) == pytest.approx(4.0)
    assert len(np.unique(ends, axis=0)) == 6
