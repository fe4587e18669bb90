"""Checks of the numbers in a message. A mission may switch each kind off, to see what it is worth.

What keeps memory safe (sizes, encodings) is no such check: it always holds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal, get_args

from services.bus.messages import MalformedMessageError

CheckName = Literal["finite", "range", "order"]
"""Finite numbers; numbers that a vehicle of this kind can have; times and counts in order."""

Checks = frozenset[CheckName]

AddedChecks = Mapping[str, Callable[[str, Any], str]]
"""Checks that other packages add, by name: of a topic and its message what is wrong, or an empty text."""

ALL_CHECKS: Checks = frozenset(get_args(CheckName))


class RefusedMessageError(MalformedMessageError):
    """A message that a check refused; ``check`` is its name."""

    def __init__(self, check: str, what: str) -> None:
        super().__init__(what)
        self.check = check


def refuse(checks: Checks, check: CheckName, what: str, *, unless: bool) -> None:
    """Refuse a message by a check that is switched on, ``unless`` it is sound in that respect.

    :raises RefusedMessageError: saying ``what`` is wrong with it.
    """
    if check in checks and not unless:
        raise RefusedMessageError(check, what)


def refuse_by_added(checks: AddedChecks, topic: str, message: Any) -> None:
    """Refuse a message by the checks that other packages add.

    :raises RefusedMessageError: with what the first of them has against it.
    """
    for name, refuses in checks.items():
        what = refuses(topic, message)
        if what:
            raise RefusedMessageError(name, what)
