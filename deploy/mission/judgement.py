"""Judges a flight by its properties and beside its golden twin: robustness, harm, what recovery did."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from deploy.errors import InfrastructureError
from services.models.detection import DetectionReport, RecoveryReport
from services.models.mission import MissionSpec
from services.models.oracles.harm import HarmEvent
from services.models.oracles.properties import PropertyResult, evaluate, parse
from services.models.outcome import Outcome
from services.models.plug_ins import Signal
from services.system import plug_ins
from sim.mission.true_path import TruePath
from sim.world import make_world

Floats = NDArray[np.float64]


def judge_properties(spec: MissionSpec, path: TruePath, twin: TruePath) -> list[PropertyResult]:
    """The properties of ``spec`` over a flight's true path; ``twin`` is the golden flight's, or its own.

    :raises InfrastructureError: if the simulator has left no path.
    """
    if not spec.properties:
        return []
    if not len(path.time_s) or not len(twin.time_s):
        raise InfrastructureError("the simulator has left no path to judge properties by")
    wanted = [parse(text) for text in spec.properties]
    values = {name: _signal(name, spec, path, twin) for name in sorted({one.signal for one in wanted})}
    return [evaluate(one, path.time_s, values[one.signal]) for one in wanted]


def _signal(name: str, spec: MissionSpec, path: TruePath, twin: TruePath) -> Floats:
    """A signal over a flight's path (n,), of ours or one that another package adds.

    :raises InfrastructureError: if another package's is not a number for each time of the path.
    """
    if name in _SIGNALS:
        return _SIGNALS[name](spec, path, twin)
    added: Signal = plug_ins.load("signals", name)
    values = np.asarray(added.values(spec, path, twin), dtype=np.float64)
    if values.shape != path.time_s.shape or np.isnan(values).any():
        message = f"signal {name!r}: not one number for each of the {len(path.time_s)} times of the path"
        raise InfrastructureError(message)
    return values


def judge_harm(flight: Outcome, twin: Outcome, end_ns: int) -> list[HarmEvent]:
    """What holds of a flight that ended at ``end_ns`` and not of its golden ``twin``, the earliest first."""
    found = []
    if twin.qof.success:
        if not flight.qof.success:
            found.append(HarmEvent(kind="mission_lost", at_ns=end_ns))
        limit_s = flight.spec.harm.time_factor * twin.qof.flight_time_s
        if flight.qof.flight_time_s > limit_s:
            found.append(HarmEvent(kind="too_slow", at_ns=round(limit_s * 1e9)))
    kept = {one.property for one in twin.properties if one.holds}
    found += [
        HarmEvent(kind="property_violated", at_ns=one.at_ns, property=one.property)
        for one in flight.properties
        if one.property in kept and not one.holds
    ]
    return sorted(found, key=lambda event: event.at_ns)


def judge_recovery(found: DetectionReport | None, path: TruePath, twin: TruePath) -> DetectionReport | None:
    """The report of a flight's detector, with what recovery did and the flight's offset from its twin."""
    if found is None or not len(path.time_s) or not len(twin.time_s):
        return found
    acted = [one for one in found.alarms if one.true and one.action != "published"]
    if not acted:
        return found
    begun = np.searchsorted(path.time_s, acted[0].virtual_time_ns / 1e9, side="right") - 1
    offsets = distance_to_path(path.position[[max(int(begun), 0), -1]], twin.position)
    report = RecoveryReport(
        actions=Counter(one.action for one in acted),
        cost_ns=sum(one.cost_ns for one in acted),
        offset_m=float(offsets[0]),
        end_offset_m=float(offsets[1]),
    )
    return found.model_copy(update={"recovery": report})


def distance_to_path(points: Floats, path: Floats) -> Floats:
    """Distance in m (n,) from each of ``points`` (n, 3) to the line through ``path`` (m, 3).

    The nearest point of the line is sought beside the nearest of the points that make it: they are a physics
    step apart, at most some cm.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415 - takes a tenth of a second

    distance, nearest = cKDTree(path).query(points)
    found: Floats = np.asarray(distance, dtype=np.float64)
    for step in (-1, 1):
        other = np.clip(nearest + step, 0, len(path) - 1)
        start, along = path[nearest], path[other] - path[nearest]
        length2 = np.einsum("ij,ij->i", along, along)
        part = np.einsum("ij,ij->i", points - start, along) / np.where(length2 > 0.0, length2, 1.0)
        foot = start + np.clip(part, 0.0, 1.0)[:, None] * along
        found = np.minimum(found, np.linalg.norm(points - foot, axis=1))
    return found


def _distance_to_goal(spec: MissionSpec, path: TruePath, _twin: TruePath) -> Floats:
    goal = make_world(spec.world, spec.seed).goal
    found: Floats = np.linalg.norm(path.position - goal, axis=1)
    return found


_SIGNALS: Mapping[str, Callable[[MissionSpec, TruePath, TruePath], Floats]] = MappingProxyType(
    {
        "clearance": lambda _spec, path, _twin: path.clearance,
        "speed": lambda _spec, path, _twin: path.speed,
        "altitude": lambda _spec, path, _twin: path.position[:, 2],
        "deviation": lambda _spec, path, twin: distance_to_path(path.position, twin.position),
        "distance_to_goal": _distance_to_goal,
        "flight_time": lambda _spec, path, _twin: path.time_s,
    }
)
"""How each of :data:`services.models.oracles.properties.SIGNALS` follows from the true path."""
