"""Properties of a flight: always or eventually, a signal within a bound, as in signal temporal logic.

The *robustness* of a property is its margin in the signal's unit: the least margin of all moments for
``always``, the greatest for ``eventually``. It is negative where the property is violated.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field

from services.models.base import Strict
from services.system import plug_ins

Floats = NDArray[np.float64]

SIGNALS: Mapping[str, str] = MappingProxyType(
    {
        "clearance": "m from the hull to the nearest obstacle",
        "speed": "m/s",
        "altitude": "m, z in the world frame",
        "deviation": "m to the nearest point of the golden twin's path",
        "distance_to_goal": "m",
        "flight_time": "s since the start: what the goal took, if it was reached",
    }
)
"""What a property may speak of, each from the simulator's true state; other packages may add signals."""

FORM = "always|eventually, [FROM,UNTIL] in s if need be, SIGNAL, >= or <=, BOUND"
EXAMPLE = "always clearance >= 0.3"
LARGEST_BOUND = 1e6
LONGEST_S = 3600.0
LONGEST_TEXT = 200

_NUMBER = r"[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
_PROPERTY = re.compile(
    rf"\s*([A-Za-z_]+)\s*(?:\[\s*({_NUMBER})\s*,\s*({_NUMBER})\s*\])?\s*\b"
    rf"([A-Za-z_]+)\s*(>=|<=)\s*({_NUMBER})\s*",
    re.ASCII,
)


class Property(NamedTuple):
    """One property; the interval is virtual time in s, without an end the flight's."""

    always: bool
    from_s: float
    until_s: float | None
    signal: str
    at_least: bool
    bound: float

    def __str__(self) -> str:
        until_s = LONGEST_S if self.until_s is None else self.until_s
        whole = self.from_s == 0.0 and self.until_s is None
        interval = "" if whole else f"[{_text(self.from_s)},{_text(until_s)}]"
        operator = "always" if self.always else "eventually"
        sign = ">=" if self.at_least else "<="
        return f"{operator}{interval} {self.signal} {sign} {_text(self.bound)}"


def _text(number: float) -> str:
    return repr(int(number)) if number.is_integer() else repr(number)


def parse(text: str) -> Property:
    """The property that is written in ``text``; its signal may be one that is not known here.

    :raises ValueError: in one line that says what is wrong and what would be right.
    """
    found = _PROPERTY.fullmatch(text) if len(text) <= LONGEST_TEXT else None
    if found is None:
        message = f"no property: expected {FORM}, e.g. '{EXAMPLE}'"
        raise ValueError(message)
    operator, low, high, signal, sign, bound = found.groups()
    if operator not in ("always", "eventually"):
        message = f"unknown operator {operator!r}; known: always, eventually"
        raise ValueError(message)
    from_s, until_s = (0.0, None) if low is None else (float(low) + 0.0, float(high) + 0.0)
    if until_s is not None and not 0.0 <= from_s <= until_s <= LONGEST_S:
        message = f"interval [{low},{high}]: expected 0 <= FROM <= UNTIL <= {LONGEST_S:g}, in s"
        raise ValueError(message)
    if abs(float(bound)) > LARGEST_BOUND:
        message = f"bound {bound}: at most {LARGEST_BOUND:g}"
        raise ValueError(message)
    return Property(operator == "always", from_s, until_s, signal, sign == ">=", float(bound) + 0.0)


PropertyText = Annotated[
    str, AfterValidator(lambda text: str(parse(text))), Field(examples=[EXAMPLE], description=FORM)
]
"""A property as people write it; kept in one spelling."""


class PropertyResult(Strict):
    """The verdict on one property of one flight, with its margin and when it was decided."""

    property: str
    robustness: float = Field(description="margin in the signal's unit; negative: violated")
    holds: bool
    at_ns: int = Field(
        description="virtual time that decided: of `always` the first violation, of `eventually` the first "
        "fulfilment; else the end of its interval or of the flight"
    )


def refuse_unknown_signal(text: str) -> None:
    """Refuse a property of a signal that neither zenfi nor another installed package has.

    :raises ValueError: naming those that are known.
    """
    signal = parse(text).signal
    if signal not in SIGNALS and not plug_ins.is_installed("signals", signal):
        raise plug_ins.UnknownPlugInError(plug_ins.unknown("signals", signal, SIGNALS))


def evaluate(wanted: Property, times_s: Floats, values: Floats) -> PropertyResult:
    """A property over a signal ``values`` (n,) at rising ``times_s`` (n,), of which there is at least one.

    Between two samples, and after the flight's end, the last value holds.
    """
    until_s = float(times_s[-1]) if wanted.until_s is None else wanted.until_s
    first = max(int(np.searchsorted(times_s, wanted.from_s, side="right")) - 1, 0)
    last = max(int(np.searchsorted(times_s, until_s, side="right")), first + 1)
    times, margins = times_s[first:last], values[first:last] - wanted.bound
    if not wanted.at_least:
        margins = -margins
    robustness = float(margins.min() if wanted.always else margins.max())
    holds = robustness >= 0.0
    decisive = margins < 0.0 if wanted.always else margins >= 0.0
    if holds != wanted.always:  # something happened that decided
        at_s = max(float(times[int(np.argmax(decisive))]), min(wanted.from_s, float(times_s[-1])))
    else:
        at_s = min(until_s, float(times_s[-1]))
    return PropertyResult(property=str(wanted), robustness=robustness, holds=holds, at_ns=round(at_s * 1e9))
