"""What the page of a run draws, from the messages of its flight and of its golden twin."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dashboard.web.charts.curves import Curve, Moment
from dashboard.web.charts.flight_style import ALARM, GOLDEN, INJECTED, RECOMPUTED, STRUCK, WITH_DETECTOR
from deploy.recording.flight_status import series
from services.bus.horizon import Stamped
from services.bus.messages import MalformedMessageError, decode
from services.bus.topics import TOPICS
from services.models.inter_kernel_states import STATES, InterKernelState
from services.models.outcome import Outcome

Floats = NDArray[np.float64]
Messages = Mapping[str, Sequence[Stamped]]

UNITS = {
    "cloud": "m",
    "collision_check.time_to_collision": "s",
    "trajectory.t": "s",
    **{f"trajectory.{name}": "m" for name in "xyz"},
    **{f"trajectory.v{name}": "m/s" for name in "xyz"},
    **{f"trajectory.a{name}": "m/s²" for name in "xyz"},
    "trajectory.yaw": "rad",
    **{f"command.v{name}": "m/s" for name in "xyz"},
    "command.yaw_rate": "rad/s",
}
"""Of the inter-kernel states; what is not here is a count."""


COLOURS = {
    "flight": GOLDEN,
    "golden": GOLDEN,
    "injected": INJECTED,
    "with detector": WITH_DETECTOR,
    "recomputed": RECOMPUTED,
    "fallback": RECOMPUTED,
}
"""Of flights, by what :func:`called` calls them; ``golden`` is the twin."""


def called(outcome: Outcome) -> str:
    """What a flight is called beside others of its fault.

    ``recomputed`` says that an output was made again after the injection, ``fallback`` that another one was
    published in the place of one that stayed alarmed. Whether that recovered the flight, one flight cannot
    tell: it takes harm as it was declared, and the flight without the detector.
    """
    if outcome.spec.fault is None:
        return "flight"
    if outcome.spec.detector is None:
        return "injected"
    alarms = outcome.detection.alarms if outcome.detection is not None else []
    actions = {one.action for one in alarms if one.true}
    if actions & {"last_good", "stop", "trail", "simple"}:
        return "fallback"
    return "recomputed" if "recomputed" in actions else "with detector"


@dataclass(frozen=True, slots=True)
class FlownPath:
    """Where a flight was, world frame: virtual ``times_s`` (n,), ``points`` (n, 3) m, ``speeds_m_s`` (n,)."""

    times_s: Floats
    points: Floats
    speeds_m_s: Floats

    @property
    def end_s(self) -> float:
        """The time of the last tick, in seconds."""
        return float(self.times_s[-1]) if len(self.times_s) else 0.0

    def at(self, time_s: float) -> Floats:
        """Where the vehicle was (3,); before the first and after the last tick it stays."""
        return np.array([np.interp(time_s, self.times_s, self.points[:, axis]) for axis in range(3)])


def way(messages: Messages) -> FlownPath:
    """The vehicle's way, as it tells it itself; ticks whose odometry is not finite are left out."""
    told = series(messages)
    return FlownPath(
        np.array([one.time_s for one in told]),
        np.array([one.position_m for one in told], dtype=np.float64).reshape(-1, 3),
        np.array([np.linalg.norm(one.velocity_m_s) for one in told]),
    )


def apart(flight: FlownPath, twin: FlownPath) -> tuple[Floats, Floats]:
    """Distance (n,) between two flights as long as both fly, m, and its times (n,)."""
    times = flight.times_s[flight.times_s <= twin.end_s]
    twins = np.column_stack([np.interp(times, twin.times_s, twin.points[:, axis]) for axis in range(3)])
    return times, np.linalg.norm(flight.points[: len(times)] - twins, axis=1)


def quantity(name: str) -> str:
    """An inter-kernel state with its unit, as on an axis; of several points it is their mean."""
    state = STATES[name]
    unit = UNITS.get(name) or UNITS.get(state.topic, "") or "count"
    return f"{name}, mean of its points ({unit})" if state.stride else f"{name} ({unit})"


def values(messages: Messages, name: str) -> tuple[Floats, Floats]:
    """Times (n,), s, and values (n,) of an inter-kernel state; NaN where a message has no finite one."""
    state = STATES[name]
    sent = messages[state.topic]
    times = np.array([one.ready_ns / 1e9 for one in sent])
    return times, np.array([_value(state, one) for one in sent], dtype=np.float64)


def _value(state: InterKernelState, message: Stamped) -> float:
    try:
        held = state.values(decode(message.payload, TOPICS[state.topic].type))
    except MalformedMessageError:
        return float("nan")
    with np.errstate(all="ignore"):
        mean = float(np.mean(held, dtype=np.float64)) if len(held) else float("nan")
    return mean if np.isfinite(mean) else float("nan")


def curves(flight: Messages, twin: Messages | None, name: str, flown: str = "injected") -> list[Curve]:
    """An inter-kernel state beside the golden twin's; ``flown`` is what the flight is called."""
    if twin is None:
        return [Curve("flight", GOLDEN, *values(flight, name))]
    return [
        Curve("golden", GOLDEN, *values(twin, name), dashed=True),
        Curve(flown, COLOURS[flown], *values(flight, name)),
    ]


def moments(outcome: Outcome) -> list[Moment]:
    """When the fault was injected and each alarm was raised."""
    return [*_strike(outcome), *_alarms(outcome)]


def _strike(outcome: Outcome) -> Iterator[Moment]:
    record = outcome.injection
    if record is not None and record.status == "injected":
        time_s = record.virtual_time_ns / 1e9
        alarmed = outcome.detection is not None and outcome.detection.alarms
        # On the left of its line, as an alarm's name is on the right; but not on the numbers of an axis.
        yield Moment("fault", STRUCK, time_s, "insideEndTop" if alarmed or time_s > 1 else "insideEndBottom")


def _alarms(outcome: Outcome) -> Iterator[Moment]:
    alarms = outcome.detection.alarms if outcome.detection is not None else []
    for number, one in enumerate(alarms):
        yield Moment("" if number else "alarm", ALARM, one.virtual_time_ns / 1e9, "insideEndBottom")


def first_choice(outcome: Outcome) -> str:
    """The state that is shown first: the corrupted one, else one that the injected stage publishes."""
    record = outcome.injection
    if record is None:
        return "command.vx"
    if record.state:
        return record.state[0]
    published = {"perception": "collision_check.time_to_collision", "planning": "trajectory.x"}
    return published.get(record.node, "command.vx")
