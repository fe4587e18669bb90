"""Model files: what comes along, and what is refused."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from detector.schemes.model_files import BadModelError, digest, read_model, to_json
from detector.schemes.registry import (
    MODELS,
    UnknownSchemeError,
    load_detector,
    scheme,
    scheme_names,
    warm_up,
    with_models,
)
from detector.series.monitored_states import WATCHED, as_check
from tests.detector.stored_lessons import load_lessons

LESSONS = Path(__file__).parents[1] / "lessons"
SHIPPED = ("autoencoder", "gaussian", "kinematic", "physical", "predictor")


def test_the_shipped_models_are_the_schemes_that_are_announced() -> None:
    assert {*SHIPPED, "reexecution"} == set(with_models()) <= set(scheme_names())


@pytest.mark.parametrize("name", ["gaussian", "kinematic"])
def test_training_again_reproduces_the_shipped_model(name: str) -> None:
    shipped, lessons = read_model(MODELS / f"{name}.json"), load_lessons(LESSONS / f"{name}.npz")
    assert digest(lessons) == shipped.provenance.lessons
    assert len(lessons) == shipped.provenance.flights == 100
    parameters = scheme(name).train(lessons, shipped.provenance.seed)
    again = shipped.model_copy(update={"parameters": parameters})
    assert to_json(again) == (MODELS / f"{name}.json").read_text()


def test_training_the_autoencoder_again_reproduces_it_to_the_rounding_of_the_processor() -> None:
    shipped, lessons = read_model(MODELS / "autoencoder.json"), load_lessons(LESSONS / "autoencoder.npz")
    assert digest(lessons) == shipped.provenance.lessons
    again = scheme("autoencoder").train(lessons, shipped.provenance.seed)
    assert numbers(again) == pytest.approx(numbers(shipped.parameters), rel=1e-4, abs=1e-4)


def numbers(part: Any) -> list[float]:
    if isinstance(part, dict):
        part = [part[key] for key in sorted(part)]
    return [number for one in part for number in numbers(one)] if isinstance(part, list) else [part]


def refused(path: Path, name: str, says: str) -> None:
    with pytest.raises(BadModelError) as error:
        load_detector(name, path)
    assert str(path) in str(error.value)
    assert says in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", SHIPPED)
def test_bad_files_are_refused_in_one_line(name: str, tmp_path: Path) -> None:
    text = (MODELS / f"{name}.json").read_text()
    path = tmp_path / "model.json"
    for cut in (0, 1, len(text) // 2, len(text) - 3):
        path.write_text(text[:cut])
        refused(path, name, "truncated")
    whole = json.loads(text)
    head, parameters, body = text.partition('"parameters"')
    for bad in ("NaN", "Infinity", "-Infinity", "1e999", '"one"', "null"):
        path.write_text(head + parameters + re.sub(r"-?\d+\.\d+", bad, body, count=1))
        refused(path, name, "")
    path.write_text(json.dumps({**whole, "states": {**whole["states"], "control": ["command.vx"]}}))
    refused(path, name, "other states")
    path.write_text(json.dumps({**whole, "parameters": {}}))
    refused(path, name, "parameters")
    path.write_text(json.dumps({**whole, "scheme": "oracle"}))
    refused(path, name, "oracle")
    path.write_bytes(b"\xff\xfe\x00")
    refused(path, name, "cannot be read")
    refused(tmp_path / "missing.json", name, "cannot be read")


def test_a_model_of_reexecution_has_no_parameters(tmp_path: Path) -> None:
    text = (MODELS / "reexecution.json").read_text()
    path = tmp_path / "model.json"
    path.write_text(json.dumps({**json.loads(text), "parameters": {"limits": [1.0]}}))
    refused(path, "reexecution", "no parameters")


def test_an_unknown_scheme_is_told_with_those_that_are_there() -> None:
    with pytest.raises(UnknownSchemeError, match="gaussian"):
        scheme("oracle")


def test_numbers_from_the_bus_become_a_check_or_are_refused() -> None:
    warm_up()
    width = len(WATCHED["control"])
    numbers = np.frombuffer(np.arange(2.0 * width).tobytes())
    check = as_check("control", numbers)
    assert check.shape == (2, width)
    assert load_detector("kinematic").check("control", check) is not None
    assert as_check("planning", np.empty(0)).shape == (0, len(WATCHED["planning"]))
    for stage, size in (("control", width), ("control", 2 * width + 1), ("perception", 4), ("sim", 2)):
        with pytest.raises(ValueError, match=stage):
            as_check(stage, np.zeros(size))
