"""The schemes that are installed, and their detectors. A scheme is an entry point of ``zenfi.detectors``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from detector.errors import DetectionInputError
from detector.schemes.base import Scheme
from detector.schemes.model_files import BadModelError, ModelFile, model_in, read_model, what_is_wrong
from detector.series.monitored_states import ROWS, WATCHED
from services.models.detection import DetectorSpec
from services.system import plug_ins

KIND = "detectors"
MODELS = Path(__file__).parents[1] / "models"
"""The trained models that come along: ``SCHEME.json``."""


class UnknownSchemeError(DetectionInputError):
    """No scheme of that name is installed, or its package is broken: one line."""


def scheme_names() -> list[str]:
    """Names of the schemes that are installed, sorted."""
    return plug_ins.names(KIND)


def scheme(name: str) -> type[Scheme]:
    """The class of an installed detection scheme.

    :raises UnknownSchemeError: if there is none, or it cannot be imported.
    """
    try:
        found: type[Scheme] = plug_ins.load(KIND, name)
    except plug_ins.UnknownPlugInError as error:
        raise UnknownSchemeError(str(error)) from error
    return found


def with_models() -> list[str]:
    """Names of the schemes of which a trained model comes along."""
    return [name for name in scheme_names() if (MODELS / f"{name}.json").exists()]


def load_detector(name: str, path: Path | None = None, *, learning: bool = True) -> Scheme:
    """A detector for one flight, from the model in ``path`` or from the one that comes along.

    :raises UnknownSchemeError: if there is no such scheme.
    :raises BadModelError: if the file is no model of this scheme.
    """
    kind = scheme(name)
    file = path if path is not None else MODELS / f"{name}.json"
    if path is None and not file.exists():
        message = f"no model comes along for detector {name!r}: train one by zenfi train {name}"
        raise BadModelError(message)
    return _with_model(kind, name, read_model(file), str(file), learning=learning)


def in_flight(spec: DetectorSpec) -> Scheme:
    """The detector that a mission asks for.

    :raises UnknownSchemeError: if there is no such scheme.
    :raises BadModelError: if its model is none of this scheme.
    """
    if spec.model is None:
        return load_detector(spec.scheme)
    where = "detector.schemes.model_files"
    return _with_model(scheme(spec.scheme), spec.scheme, model_in(spec.model, where), where, learning=True)


def _with_model(kind: type[Scheme], name: str, model: ModelFile, where: str, *, learning: bool) -> Scheme:
    if model.scheme != name:
        message = f"{where}: a model of {model.scheme!r}, not of {name!r}"
        raise BadModelError(message)
    try:
        return kind.load(model.parameters, learning=learning)
    except ValueError as error:
        message = f"{where}: no parameters of {name!r} ({what_is_wrong(error)})"
        raise BadModelError(message) from error


def warm_up() -> None:
    """Compile the detectors that come along before there is a flight."""
    for name in with_models():
        rehearse(load_detector(name))


def rehearse(detector: Scheme) -> None:
    """Let a detector judge once at each stage, so that it is compiled; it remembers nothing of it."""
    for stage, columns in WATCHED.items():
        for writeable in (True, False):
            # What comes from the bus is read-only: to numba a type of its own.
            values = np.zeros((ROWS[stage] or 3, len(columns)))
            values.setflags(write=writeable)
            detector.score(stage, values)
