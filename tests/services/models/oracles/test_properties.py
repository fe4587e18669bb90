"""Properties: what may be written, and the arithmetic of their robustness."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from services.models.mission import MissionSpec
from services.models.oracles.properties import evaluate, parse, refuse_unknown_signal

TIMES = np.array([0.0, 1.0, 2.0, 3.0])
VALUES = np.array([4.0, 1.0, 3.0, 2.0])


@pytest.mark.parametrize(
    ("text", "robustness", "holds", "at_s"),
    [
        ("always clearance >= 0.5", 0.5, True, 3.0),
        ("always clearance >= 1", 0.0, True, 3.0),
        ("always clearance >= 2.5", -1.5, False, 1.0),
        ("always clearance <= 3", -1.0, False, 0.0),
        ("eventually clearance <= 1.5", 0.5, True, 1.0),
        ("eventually clearance >= 5", -1.0, False, 3.0),
        ("eventually[0,2] clearance >= 5", -1.0, False, 2.0),
        ("always[2,3] clearance >= 1.5", 0.5, True, 3.0),
        ("always[1.5,1.75] clearance >= 2", -1.0, False, 1.5),  # the value of 1 s still holds
        ("eventually[9,10] clearance >= 2", 0.0, True, 3.0),  # the last value goes on
        ("always[9,10] clearance >= 2.5", -0.5, False, 3.0),
    ],
)
def test_robustness_is_the_least_or_the_greatest_margin(
    text: str, robustness: float, holds: bool, at_s: float
) -> None:
    found = evaluate(parse(text), TIMES, VALUES)
    assert (found.robustness, found.holds, found.at_ns) == (robustness, holds, round(at_s * 1e9))


@given(
    values=st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=30),
    bound=st.integers(-1000, 1000),
    low=st.integers(0, 40),
    length=st.integers(0, 40),
)
def test_always_is_the_opposite_of_eventually_the_opposite(
    values: list[float], bound: int, low: int, length: int
) -> None:
    times, signal = np.arange(len(values), dtype=np.float64), np.array(values)
    window = f"[{low},{low + length}] speed"
    always = evaluate(parse(f"always{window} >= {bound}"), times, signal)
    never = evaluate(parse(f"eventually{window} <= {bound}"), times, signal)
    assert always.robustness == -never.robustness
    first = min(low, len(values) - 1)
    within = values[first : max(low + length + 1, first + 1)]
    assert always.robustness == min(within) - bound
    assert always.holds == (always.robustness >= 0.0)


def test_a_property_has_one_spelling() -> None:
    spec = MissionSpec.model_validate(
        {"properties": ["  always   clearance>=0.30", "eventually[0, 60.0] speed<=1"]}
    )
    assert spec.properties == ("always clearance >= 0.3", "eventually[0,60] speed <= 1")
    assert MissionSpec.model_validate_json(spec.model_dump_json()) == spec


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("always clearance > 0.3", "no property: expected"),
        ("alwaysclearance >= 0.3", "no property: expected"),
        ("always clearance >= nan", "no property: expected"),
        ("never clearance >= 0.3", "unknown operator 'never'; known: always, eventually"),
        ("always[5,2] speed <= 1", "interval"),
        ("always[0,9999] speed <= 1", "interval"),
        ("always speed <= 1e300", "at most 1e"),
    ],
)
def test_what_is_no_property_is_refused_in_one_line(text: str, message: str) -> None:
    with pytest.raises(ValidationError, match=message.replace("[", r"\[")):
        MissionSpec.model_validate({"properties": [text]})


def test_a_signal_that_nobody_has_is_refused_before_the_flight() -> None:
    refuse_unknown_signal("always clearance >= 0.3")
    with pytest.raises(ValueError, match="unknown signal 'height'; known: clearance"):
        refuse_unknown_signal("always height >= 0.3")


def test_the_same_property_twice_is_refused() -> None:
    with pytest.raises(ValidationError, match="twice the same property: always speed <= 1"):
        MissionSpec.model_validate({"properties": ["always speed <= 1", "always speed <= 1.0"]})
