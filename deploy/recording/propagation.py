"""How an error passed on to the flight command, from the messages of a flight and its golden twin."""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from deploy.recording.recorder import Divergence, FlightTrace
from services.bus.arrays import POINT_FIELDS, Floats, xyz
from services.bus.fields import flat, same
from services.bus.horizon import Stamped
from services.bus.messages import MalformedMessageError, decode
from services.bus.topics import MADE_FROM, RECORDED, TICK_NS, TOPICS, Topic
from services.models.inter_kernel_states import STATES
from services.models.outcome import InjectionRecord
from services.models.propagation import Propagation, Strayed

Messages = Mapping[str, Sequence[Stamped]]
"""Of a whole flight, by topic, in order of sequence."""

FAULT = "fault"
COMMAND = "command"
FAR_M = 20.0
"""Where a pixel without a return is taken to be: the cameras' usual range."""


class Measure(NamedTuple):
    """The deviation between two messages of a topic, in a flight to ``goal``; not finite if undefined."""

    unit: str
    between: Callable[[Any, Any, Any], float]


class DeviationPoint(NamedTuple):
    """How far a message strayed: virtual time at which it was ready, deviation or None."""

    at_ns: int
    deviation: float | None


def propagation(flight: Messages, twin: Messages, injection: InjectionRecord | None = None) -> Propagation:
    """What strayed from the golden ``twin``, when, how far, and through what."""
    traces = FlightTrace.of(flight), FlightTrace.of(twin)
    left: dict[str, Divergence] = {}
    for topic in RECORDED:
        found = traces[0].divergence(topic.name, traces[1])
        if found is not None:
            left[topic.name] = found
    struck = injection if injection is not None and injection.status == "injected" else None
    strayed = [_strayed(TOPICS[name], left, flight, twin, struck) for name in left]
    return Propagation(
        struck_at_ns=struck.virtual_time_ns if struck is not None else None,
        struck_stage=struck.node if struck is not None else "",
        command_at_ns=left[COMMAND].at_ns if COMMAND in left else None,
        topics=sorted(strayed, key=lambda one: (one.at_ns, TOPICS[one.topic].rank)),
        same=[topic.name for topic in RECORDED if topic.name not in left],
    )


def growth(topic: str, flight: Messages, twin: Messages) -> list[DeviationPoint]:
    """Deviation of every message of a topic from the twin's last message at that time."""
    measure = _MEASURES.get(topic)
    others = twin[topic]
    times = [message.ready_ns for message in others]
    goal = _read("goal", twin["goal"][0]) if twin["goal"] else None
    points = []
    for message in flight[topic]:
        place = bisect.bisect_right(times, message.ready_ns) - 1
        if place < 0 or measure is None:
            continue
        other = others[place]
        apart = 0.0 if message.payload == other.payload else _apart(measure, topic, (message, other), goal)
        points.append(DeviationPoint(message.ready_ns, apart))
    return points


def unit(topic: str) -> str:
    """The unit of a topic's deviation; empty if it has none."""
    measure = _MEASURES.get(topic)
    return measure.unit if measure is not None else ""


def _strayed(
    topic: Topic,
    left: Mapping[str, Divergence],
    flight: Messages,
    twin: Messages,
    struck: InjectionRecord | None,
) -> Strayed:
    here = left[topic.name]
    grown = [one for one in growth(topic.name, flight, twin) if one.at_ns >= here.at_ns]
    measured = [(one.deviation, one.at_ns) for one in grown if one.deviation]
    largest = max(measured, key=lambda one: one[0], default=(None, None))
    return Strayed(
        topic=topic.name,
        stage=topic.publisher,
        at_ns=here.at_ns,
        tick=here.at_ns // TICK_NS,
        message=here.message,
        fields=list(_differing(topic.name, here.message, flight, twin)),
        causes=list(_causes(topic, left, struck)),
        unit=unit(topic.name),
        first=measured[0][0] if measured else None,
        largest=largest[0],
        largest_at_ns=largest[1],
        last=grown[-1].deviation if grown else None,
    )


def _causes(topic: Topic, left: Mapping[str, Divergence], struck: InjectionRecord | None) -> Iterator[str]:
    """Within one instant a stage sees what the stages before it publish."""
    here_ns = left[topic.name].at_ns
    if struck is not None and struck.node == topic.publisher and struck.virtual_time_ns <= here_ns:
        yield FAULT
    for name in MADE_FROM[topic.name]:
        if name in left:
            earlier = left[name].at_ns, TOPICS[name].rank
            if earlier < (here_ns, topic.rank):
                yield name


def _differing(topic: str, number: int, flight: Messages, twin: Messages) -> Iterator[str]:
    """The fields of a message that differ; a number of each trajectory point by the name of its state."""
    if number >= min(len(flight[topic]), len(twin[topic])):
        return
    try:
        one, other = _read(topic, flight[topic][number]), _read(topic, twin[topic][number])
    except MalformedMessageError:
        return
    for (name, value), (_, twins) in zip(flat(one), flat(other), strict=True):
        if same(value, twins):
            continue
        states = [state for state in STATES.values() if state.topic == topic and state.path == (name,)]
        columns = [state for state in states if state.stride]
        if not columns or value.shape != twins.shape:
            yield name
            continue
        for state in columns:
            if not same(state.values(one), state.values(other)):
                yield state.name.partition(".")[2]


def _apart(measure: Measure, topic: str, pair: tuple[Stamped, Stamped], goal: Any) -> float | None:
    try:
        with np.errstate(all="ignore"):
            deviation = measure.between(_read(topic, pair[0]), _read(topic, pair[1]), goal)
    except (MalformedMessageError, ValueError):
        return None  # what a fault made of it may be anything
    return deviation if math.isfinite(deviation) else None


def _read(topic: str, message: Stamped) -> Any:
    return decode(message.payload, TOPICS[topic].type)


def _voxels(one: Any, other: Any, goal: Any) -> float:
    """Voxels of the space that may be flown in of which the maps do not say the same."""
    low, high = xyz(goal.lower), xyz(goal.upper)
    from services.bus.octomaps import known  # noqa: PLC0415 - loads numba

    maps = [known(message.data.tobytes(), other.resolution, low, high) for message in (one, other)]
    return float(np.count_nonzero(maps[0] != maps[1]))


def _vector(values: Callable[[Any], Floats]) -> Callable[[Any, Any, Any], float]:
    return lambda one, other, _goal: float(np.linalg.norm(values(one) - values(other)))


def _pixels(one: Any, other: Any, _goal: Any) -> float:
    images = [
        np.nan_to_num(message.data.view(np.float32), nan=FAR_M, posinf=FAR_M, neginf=0.0)
        for message in (one, other)
    ]
    return float(np.abs(images[0] - images[1]).mean(dtype=np.float64))


def _points(one: Any, other: Any, _goal: Any) -> float:
    """Mean way from point to point; if there are more or fewer, to the nearest point of the other cloud."""
    a, b = (message.data.view(np.float32).reshape(-1, 3).astype(np.float64) for message in (one, other))
    if len(a) == len(b):
        return float(np.linalg.norm(a - b, axis=1).mean()) if len(a) else 0.0
    if not len(a) or not len(b):
        return math.nan
    from scipy.spatial import KDTree  # noqa: PLC0415 - slow to import

    ways = (np.mean(KDTree(there).query(here)[0]) for here, there in ((a, b), (b, a)))
    return float(max(ways))


def _urgency(one: Any, other: Any, _goal: Any) -> float:
    left_s, twins_s = one.time_to_collision, other.time_to_collision
    return 0.0 if left_s == twins_s else abs(left_s - twins_s)


def _curves(one: Any, other: Any, _goal: Any) -> float:
    """Greatest distance between two trajectories at a time that both cover."""
    a, b = (message.points.reshape(-1, POINT_FIELDS) for message in (one, other))
    if not len(a) or not len(b):
        return 0.0 if len(a) == len(b) else math.nan
    times = np.union1d(a[:, 0], b[:, 0])
    times = times[(times >= max(a[0, 0], b[0, 0])) & (times <= min(a[-1, 0], b[-1, 0]))]
    if not len(times):
        return math.nan
    ways = [np.stack([np.interp(times, p[:, 0], p[:, axis]) for axis in (1, 2, 3)]) for p in (a, b)]
    return float(np.linalg.norm(ways[0] - ways[1], axis=0).max())


_MEASURES: Mapping[str, Measure] = MappingProxyType(
    {
        "goal": Measure("m", _vector(lambda message: xyz(message.position))),
        "odometry": Measure("m", _vector(lambda message: xyz(message.pose.pose.position))),
        "imu": Measure("m/s^2", _vector(lambda message: message.linear_acceleration.reshape(-1, 3).mean(0))),
        "depth": Measure("m", _pixels),
        "cloud": Measure("m", _points),
        "map": Measure("voxels", _voxels),
        "collision_check": Measure("s", _urgency),
        "trajectory": Measure("m", _curves),
        "command": Measure("m/s", _vector(lambda message: xyz(message.twist.linear))),
    }
)
