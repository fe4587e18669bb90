"""What a specification names by file or by name with parameters, put in its place."""

import pytest

from deploy.config.definitions import inlined
from deploy.errors import BadSpecError
from services.models.mission import MissionSpec
from services.models.world import ForestWorld, TrafficWorld


def world(text: str) -> object:
    return MissionSpec.model_validate(inlined({"world": text})).world


def test_a_world_is_asked_for_with_other_parameters() -> None:
    forest = world("forest,difficulty=0.8")
    assert isinstance(forest, ForestWorld)
    assert (forest.name, forest.difficulty) == ("forest-0.8", 0.8)
    traffic = world("traffic,movers=6,speed_m_s=1.2")
    assert isinstance(traffic, TrafficWorld)
    assert (traffic.movers, traffic.speed_m_s) == (6, 1.2)
    assert traffic.name == "traffic-movers-6-speed_m_s-1.2"
    assert world("forest") == "forest"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("frest,difficulty=0.5", "unknown world 'frest'; known: .*forest"),
        ("forest,difficulty=2", "difficulty: .*less than or equal to 1, got 2"),
        ("forest,density=0.2", "density: Extra inputs"),
        ("forest,difficulty", r"is not FIELD=NUMBER, as in forest,difficulty=0\.8"),
        ("forest,difficulty=hard", "is not FIELD=NUMBER"),
        ("forest,start=[0, 0, 2]", "is not FIELD=NUMBER"),
    ],
)
def test_what_is_no_parameter_is_refused_in_a_line(text: str, says: str) -> None:
    with pytest.raises(BadSpecError, match=says) as refused:
        world(text)
    assert "\n" not in str(refused.value)
