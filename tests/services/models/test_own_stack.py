"""What a stack of one's own may say."""

import pytest
from pydantic import ValidationError

from services.bus.topics import TOPICS
from services.models.mission import MissionSpec
from services.models.own_stack import OwnStack


def stack(stage: str, inputs: list[str]) -> dict[str, object]:
    own = {
        "command": ["/bin/true"],
        "folder": "/",
        "sha256": "0" * 64,
        "inputs": inputs,
        "latency": {"mean_ms": 1},
    }
    return {"name": "mine", "stages": {stage: own}}


@pytest.mark.parametrize(
    ("stage", "inputs", "told"),
    [
        ("sim", [], "perception"),
        ("control", ["command"], "control cannot have the input 'command'"),
        ("control", ["trajektory"], "it can have .*trajectory"),
        ("control", ["odometry"], "not odometry, which sets it going"),
        ("planning", ["odometry", "odometry"], "name each once"),
    ],
)
def test_what_makes_no_sense_is_refused(stage: str, inputs: list[str], told: str) -> None:
    with pytest.raises(ValidationError, match=told):
        OwnStack.model_validate(stack(stage, inputs))


def test_the_only_kernel_of_such_a_stage_is_itself() -> None:
    spec = MissionSpec.model_validate({"stack": stack("planning", ["odometry", "map"])})
    assert spec.kernels_before(TOPICS["trajectory"]) == ("planning",)
    assert spec.kernels_before(TOPICS["command"]) == ("pid",)
    assert MissionSpec(planner="rrt").kernels_before(TOPICS["trajectory"]) == ("rrt",)
