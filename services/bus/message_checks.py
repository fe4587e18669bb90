"""Checks of the numbers in a message. A mission may switch each kind off, to see what it is worth.

What keeps memory safe (sizes, encodings) is no such check: it always holds.
"""

from __future__ import annotations

from typing import Literal, get_args

from services.bus.messages import MalformedMessageError

CheckName = Literal["finite", "range", "order"]
"""Finite numbers; numbers that a vehicle of this kind can have; times and counts in order."""

Checks = frozenset[CheckName]

ALL_CHECKS: Checks = frozenset(get_args(CheckName))


class RefusedMessageError(MalformedMessageError):
    """A message that a check refused; ``check`` is its name."""

    def __init__(self, check: CheckName, what: str) -> None:
        super().__init__(what)
        self.check: CheckName = check


def refuse(checks: Checks, check: CheckName, what: str, *, unless: bool) -> None:
    """Refuse a message by a check that is switched on, ``unless`` it is sound in that respect.

    :raises RefusedMessageError: saying ``what`` is wrong with it.
    """
    if check in checks and not unless:
        raise RefusedMessageError(check, what)
