"""The way back is the way that the vehicle came."""

import numpy as np
import pytest

from services.planning.trail import SPACING_M, Trail


def flown(*places: tuple[float, float, float]) -> Trail:
    trail = Trail()
    for place in places:
        trail.add(np.array(place))
    return trail


def test_it_leads_back_to_the_beginning_from_where_the_vehicle_is() -> None:
    path = flown((0, 0, 1), (0, 0, 2), (3, 0, 2)).back(np.array([4.0, 1.0, 2.0]), 100.0)
    assert path is not None
    assert path.tolist() == [[4, 1, 2], [3, 0, 2], [0, 0, 2], [0, 0, 1]]


@pytest.mark.parametrize(("length_m", "left_at"), [(100.0, 0.0), (2.6, 8.0), (2.4, 8.0), (1.0, 9.0)])
def test_it_is_no_longer_than_asked_for(length_m: float, left_at: float) -> None:
    path = flown(*((float(x), 0.0, 2.0) for x in range(10))).back(np.array([10.0, 0.0, 2.0]), length_m)
    assert path is not None
    assert path[-1, 0] == left_at


def test_who_has_come_nowhere_has_no_way_back() -> None:
    here = np.array([1.0, 1.0, 2.0])
    assert Trail().back(here, 10.0) is None
    assert flown((1, 1, 2), (1.1, 1, 2)).back(here, 10.0) is None
    assert flown((1, 1, 2)).back(here + 5.0, 1.0) is None


def test_places_near_each_other_are_kept_once_and_not_with_what_changes_later() -> None:
    trail, place = Trail(), np.array([0.0, 0.0, 2.0])
    for _ in range(100):
        place[0] += 0.1
        trail.add(place)
    path = trail.back(np.array([20.0, 0.0, 2.0]), 1000.0)
    assert path is not None
    steps = np.linalg.norm(np.diff(path[1:], axis=0), axis=1)
    assert steps == pytest.approx([SPACING_M] * len(steps), abs=0.11)
    assert path[-1].tolist() == [0.1, 0.0, 2.0]
