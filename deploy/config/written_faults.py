"""Faults and detectors as people write them: ``instruction:pid,field=exponent``, ``gaussian,gate=off``."""

from __future__ import annotations

import re

from deploy.config.definitions import inlined
from deploy.errors import BadSpecError
from services.models.faults.specification import FaultSpec

FAULT_FORM = "LEVEL:TARGET[,NAME=VALUE...]"
DETECTOR_FORM = "SCHEME[,NAME=VALUE...]"
_LISTS = ("bit_numbers", "registers", "opcodes", "where_set", "where_clear")
_ELSEWHERE = {
    "seed": "--fault-seed (fault_seed in Python)",
    "level": f"the form {FAULT_FORM}",
    "target": f"the form {FAULT_FORM}",
}


def parse_fault(text: str, seed: int = 0, over: str = "calls") -> FaultSpec:
    """The fault in ``text``: fields of :class:`FaultSpec` after the kernel; entries of a list go with ``+``.

    The injection point is drawn ``over`` the "calls" or the "time" of the flight.

    :raises BadSpecError: if it has not the form.
    :raises pydantic.ValidationError: if a field or value is none, or they do not go together.
    """
    head, *settings = text.split(",")
    level, colon, target = head.partition(":")
    if not colon:
        message = f"fault {text!r}: expected {FAULT_FORM}, e.g. instruction:rrt_star,field=exponent,bits=2"
        raise BadSpecError(message)
    fields = fault_fields(",".join(settings))
    given = {"level": level, "target": target, "seed": seed, "trigger": {"over": over}, **fields}
    return FaultSpec.model_validate(given)


def fault_fields(text: str) -> dict[str, object]:
    """The fields in ``NAME=VALUE[,NAME=VALUE...]``, of which there may be none; a histogram is a file's.

    :raises BadSpecError: if it has not the form, or the file cannot be read or is malformed.
    """
    fields: dict[str, object] = {}
    for setting in text.split(",") if text else ():
        name, equals, value = setting.partition("=")
        if not equals or name in fields:
            what = "twice the same name" if equals else "no NAME=VALUE"
            message = f"fault: {what} in {setting!r}"
            raise BadSpecError(message)
        if name in _ELSEWHERE:
            message = f"fault: {name} is given by {_ELSEWHERE[name]}"
            raise BadSpecError(message)
        words = [_number(word) for word in value.split("+")]
        fields[name] = words if name in _LISTS else _number(value)
    return dict(inlined({"fault": fields})["fault"])


def _number(word: str) -> int | float | str:
    """Numbers as numbers: a specification takes no text for one of two values."""
    if word.isascii() and word.isdigit():
        return int(word)
    return float(word) if re.fullmatch(r"[0-9]+\.[0-9]*", word) else word


def detector_fields(text: str) -> dict[str, str]:
    """The fields of :class:`DetectorSpec` in ``text``; a model is a file's name yet.

    :raises BadSpecError: if it has not the form.
    """
    scheme, *settings = text.split(",")
    fields = {"scheme": scheme}
    for setting in settings:
        name, equals, value = setting.partition("=")
        if not equals or name in fields:
            what = "twice the same name" if equals else "no NAME=VALUE"
            message = f"detector: {what} in {setting!r}; expected {DETECTOR_FORM}"
            raise BadSpecError(message)
        fields[name] = value
    return fields
