"""A fault as it is written on the command line."""

from __future__ import annotations

from deploy.check import BadSpecError
from services.bus.mission import FaultSpec

FORM = "LEVEL:KERNEL[,NAME=VALUE...]"
_LISTS = ("bit_numbers",)
_ELSEWHERE = {"seed": "--fault-seed", "level": f"the form {FORM}", "target": f"the form {FORM}"}


def parse_fault(text: str, seed: int, over: str) -> FaultSpec:
    """The fault in ``text``: fields of :class:`FaultSpec` after the kernel; numbers of a list go with ``+``.

    What it strikes is drawn ``over`` the "calls" or the "time" of the flight.

    :raises BadSpecError: if it has not the form.
    :raises pydantic.ValidationError: if a field or value is none, or they do not go together.
    """
    head, *settings = text.split(",")
    level, colon, target = head.partition(":")
    if not colon:
        message = f"--fault {text!r}: expected {FORM}, e.g. instruction:rrt_star,field=exponent,bits=2"
        raise BadSpecError(message)
    fields = fault_fields(",".join(settings))
    given = {"level": level, "target": target, "seed": seed, "trigger": {"over": over}, **fields}
    return FaultSpec.model_validate(given)


def fault_fields(text: str) -> dict[str, object]:
    """The fields in ``NAME=VALUE[,NAME=VALUE...]``, of which there may be none.

    :raises BadSpecError: if it has not the form.
    """
    fields: dict[str, object] = {}
    for setting in text.split(",") if text else ():
        name, equals, value = setting.partition("=")
        if not equals or name in fields:
            what = "twice the same name" if equals else "no NAME=VALUE"
            message = f"--fault: {what} in {setting!r}"
            raise BadSpecError(message)
        if name in _ELSEWHERE:
            message = f"--fault: {name} is given by {_ELSEWHERE[name]}"
            raise BadSpecError(message)
        words = [_number(word) for word in value.split("+")]
        fields[name] = words if name in _LISTS else _number(value)
    return fields


def _number(word: str) -> int | str:
    """Numbers as numbers: a specification takes no text for one of two values."""
    return int(word) if word.isascii() and word.isdigit() else word
