"""Model files: the parameters of a scheme as JSON, with what they were learned from."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from detector.errors import DetectionInputError
from detector.schemes.base import Lesson
from detector.series.monitored_states import WATCHED
from services.models.base import Strict, first_problem

DIGEST_BYTES = 16


class BadModelError(DetectionInputError):
    """A file that is no model, or not one for what is watched now: one line that names it."""


class Provenance(Strict):
    """Where a model comes from. ``lessons`` is the digest of all that was learned from, flight by flight."""

    command: str
    worlds: list[str]
    seeds: list[int]
    flights: int
    lessons: str
    seed: int


class ModelFile(Strict):
    """One model. ``states`` are the columns that it was trained for; ``parameters`` are its scheme's."""

    scheme: str
    states: dict[str, list[str]]
    provenance: Provenance
    parameters: dict[str, Any]


def digest(lessons: Sequence[Lesson]) -> str:
    """The digest over every array of every lesson, in order."""
    whole = hashlib.blake2b(digest_size=DIGEST_BYTES)
    for lesson in lessons:
        for name, array in lesson.items():
            whole.update(f"{name} {array.dtype.str} {array.shape}".encode())
            whole.update(np.ascontiguousarray(array).tobytes())
    return whole.hexdigest()


def make(scheme: str, parameters: Mapping[str, Any], provenance: Provenance) -> ModelFile:
    """The model of a scheme trained for what is watched now."""
    states = {stage: list(columns) for stage, columns in WATCHED.items()}
    return ModelFile(scheme=scheme, states=states, provenance=provenance, parameters=dict(parameters))


def to_json(model: ModelFile) -> str:
    """The text of a model file: the same model, the same bytes."""
    return json.dumps(model.model_dump(mode="json"), indent=1, allow_nan=False) + "\n"


def read_model(path: Path) -> ModelFile:
    """Read a model file; whether its parameters fit its scheme is for the scheme to say.

    :raises BadModelError: if it is truncated, holds what is not finite, or was trained for other states.
    """
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        message = f"{path}: cannot be read as a model ({error})"
        raise BadModelError(message) from error
    try:
        given = json.loads(text, parse_constant=_refuse)
    except ValueError as error:
        message = f"{path}: not a model file, or truncated ({error})"
        raise BadModelError(message) from error
    return model_in(given, str(path))


def model_in(given: Any, where: str) -> ModelFile:
    """The model that ``given``, the content of a file, makes; ``where`` names it in errors.

    :raises BadModelError: if it is none, or was trained for other states.
    """
    try:
        model = ModelFile.model_validate(given)
    except ValidationError as error:
        message = f"{where}: not a model file ({what_is_wrong(error)})"
        raise BadModelError(message) from error
    if model.states != {stage: list(columns) for stage, columns in WATCHED.items()}:
        message = f"{where}: trained for other states; train it again"
        raise BadModelError(message)
    return model


def what_is_wrong(error: ValueError) -> str:
    """The first thing that is wrong, in one line."""
    return first_problem(error) if isinstance(error, ValidationError) else str(error)


def _refuse(constant: str) -> float:
    message = f"{constant} is no number"
    raise ValueError(message)
