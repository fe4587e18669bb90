"""The specification: profiles, definitions of one's own, refusals."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from deploy.errors import one_line
from services.models.equipment import PROFILES
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec


def test_the_paper_profile_sets_the_published_parameters() -> None:
    paper = MissionSpec.model_validate({"profile": "paper", "seed": 3})
    assert (paper.camera.width, paper.camera.height, paper.camera.fov_deg) == (256, 144, 90.0)
    assert 0.1 <= paper.mapping.resolution_m <= 0.2
    assert paper.mapping.range_m == 7.0
    assert (paper.motion.speed_m_s, paper.motion.acceleration_m_s2) == (3.0, 5.0)
    assert paper.seed == 3


def test_a_field_that_is_given_goes_before_the_profile() -> None:
    spec = MissionSpec.model_validate({"profile": "paper", "mapping": {"resolution_m": 0.1}})
    assert spec.mapping.resolution_m == 0.1
    assert spec.camera.width == 256


def test_the_fast_profile_is_the_default() -> None:
    assert MissionSpec.model_validate({"profile": "fast"}) == MissionSpec()
    assert set(PROFILES) == {"fast", "paper"}


def test_a_specification_survives_json_with_its_definitions() -> None:
    spec = MissionSpec.model_validate(
        {
            "profile": "paper",
            "world": {"name": "mine", "kind": "grid", "density": 0.1, "obstacle_m": 2.0},
            "platform": {"name": "a", "source": "", "kernels": {"pid": {"mean_ms": 1.0, "jitter": 0.1}}},
        }
    )
    again = MissionSpec.model_validate_json(spec.model_dump_json())
    assert again == spec
    assert again.world_name == "mine"


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"profile": "huge"}, "huge"),
        ({"profile": 3}, "3"),
        ({"camera": {"width": 0}}, "camera.width"),
        ({"camera": {"noise_per_m": -1}}, "noise_per_m"),
        ({"mapping": {"resolution_m": 2.0}}, "resolution_m"),
        ({"motion": {"speed_m_s": 9.0}}, "speed_m_s"),
        ({"wind": {"gust_m_s": [1.0, 1.0]}}, "gust_m_s"),
        ({"wind": {"mean_m_s": [float("nan"), 0.0, 0.0]}}, "mean_m_s"),
        ({"imu": {"rate_hz": 1000.0}}, "rate_hz"),
        ({"odometry": {"drift_m_sqrt_s": -0.1}}, "drift"),
        ({"platform": {"name": "x", "source": "", "kernels": {"pid": {"mean_ms": -1.0}}}}, "mean_ms"),
        (
            {"platform": {"name": "x", "source": "", "kernels": {"pid": {"mean_ms": 1, "jitter": 1}}}},
            "jitter",
        ),
    ],
)
def test_a_bad_value_is_refused_by_name(fields: dict[str, object], says: str) -> None:
    with pytest.raises(ValidationError, match=says):
        MissionSpec.model_validate(fields)


STUCK = {"model": "stuck_at", "stuck_value": 1, "stuck_instructions": 10}


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"model": "stuck_at"}, "stuck_value"),
        ({"model": "stuck_at", "stuck_value": 1}, "stuck_instructions"),
        ({**STUCK, "stuck_value": 2}, "stuck_value"),
        ({**STUCK, "stuck_instructions": 0}, "stuck_instructions"),
        ({"stuck_value": 0, "stuck_instructions": 3}, "not bitflip"),
        ({"model": "opcode", "register_class": "gpr"}, "register_class"),
        ({"model": "opcode", "operand": "source"}, "operand"),
        ({"model": "opcode", "field": "sign"}, "field"),
        ({"model": "memory", "register_class": "vector"}, "register_class"),
        ({"field": "exponent", "register_class": "flags"}, "floating-point"),
        ({"field": "sign", "bits": 2}, "sign has at most 1"),
        ({"field": "exponent", "bits": 12}, "exponent has at most 11"),
        ({"field": "mantissa", "bit_numbers": (3,)}, "leave out one"),
        ({"bit_numbers": ()}, "bit_numbers"),
        ({"bit_numbers": (3, 3)}, "distinct"),
        ({"bit_numbers": (512,)}, "512"),
        ({"bit_numbers": (3, 4), "bits": 3}, "leave out bits"),
        ({"bits": 0}, "bits"),
        ({"bits": 65}, "bits"),
        ({"register_class": "x87"}, "register_class"),
        ({"scope": "module"}, "scope"),
    ],
)
def test_a_fault_that_makes_no_sense_is_refused_in_one_line(fields: dict[str, Any], says: str) -> None:
    with pytest.raises(ValidationError, match=says) as refusal:
        FaultSpec.model_validate({"target": "pid", **fields})
    assert "\n" not in one_line(refusal.value)


@pytest.mark.parametrize(
    "fields",
    [
        STUCK,
        {**STUCK, "field": "exponent", "register_class": "vector", "bits": 11},
        {"model": "memory", "field": "mantissa", "operand": "destination", "bits": 52},
        {"model": "opcode", "bit_numbers": (3, 9)},
        {"register_class": "mask", "scope": "kernel", "model": "none"},
    ],
)
def test_a_fault_survives_json(fields: dict[str, Any]) -> None:
    fault = FaultSpec.model_validate({"target": "pid", **fields})
    assert FaultSpec.model_validate_json(fault.model_dump_json()) == fault


@pytest.mark.parametrize(
    ("fields", "problem"),
    [
        ({"recurrence": "intermittent"}, "probability go together"),
        ({"probability": 0.5}, "probability go together"),
        ({"recurrence": "rate", "probability": 0.5}, "go together"),
        ({"from_s": 1.0}, "from_s and until_s go with a recurrence"),
        ({"recurrence": "permanent", "from_s": 3.0, "until_s": 2.0}, "not after from_s"),
    ],
)
def test_a_recurrence_says_what_it_needs(fields: dict[str, object], problem: str) -> None:
    with pytest.raises(ValidationError, match=problem):
        FaultSpec.model_validate({"level": "source", "target": "command.vx", **fields})


@pytest.mark.parametrize(
    ("fields", "problem"),
    [
        ({"recurrence": "permanent"}, "needs opcodes"),
        ({"recurrence": "permanent", "opcodes": [""]}, "expected mnemonics"),
        ({"opcodes": ["mulsd"]}, "opcodes goes with level instruction and recurrence"),
        (
            {"recurrence": "permanent", "opcodes": ["mulsd"], "model": "memory"},
            "goes with model bitflip or none",
        ),
        ({"recurrence": "rate", "rate_hz": 1.0, "model": "opcode"}, "bitflip or memory or none"),
        ({"recurrence": "rate", "rate_hz": 1.0, "scope": "thread"}, "leave out scope"),
        ({"recurrence": "rate", "rate_hz": 1.0, "trigger": {"cpu_ns": 5}}, "has no one site"),
        ({"where_set": [3]}, "where_set and where_clear go with level instruction and recurrence permanent"),
        ({"recurrence": "rate", "rate_hz": 1.0, "where_clear": [3]}, "go with level instruction"),
        ({"recurrence": "permanent", "opcodes": ["mulsd"], "where_set": [64]}, "numbers from 0 to 63"),
        ({"recurrence": "permanent", "opcodes": ["mulsd"], "where_set": []}, "numbers from 0 to 63"),
        (
            {"recurrence": "permanent", "opcodes": ["mulsd"], "where_set": [3], "where_clear": [3]},
            r"expected distinct numbers from 0 to 63, got \[3, 3\]",
        ),
    ],
)
def test_a_fault_that_recurs_in_instructions_says_what_it_needs(
    fields: dict[str, object], problem: str
) -> None:
    with pytest.raises(ValidationError, match=problem):
        FaultSpec.model_validate({"target": "pid", **fields})
