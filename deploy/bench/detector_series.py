"""Converts a flight's messages into the checks that its stages would have asked a detector for."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from deploy.config.platform import load_platform
from deploy.mission.flight import FlownMission, fly
from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import compare, draw_call
from detector.series.monitored_states import WATCHED
from detector.series.series import Checks, Series
from services.bus.arrays import Floats, plan, state, verdict
from services.bus.detector_protocol import shown_command, shown_trajectory, shown_verdict
from services.bus.horizon import Stamped
from services.bus.messages import MalformedMessageError, decode
from services.bus.topics import STAGES, TICK_NS, TOPICS
from services.models.detection import DetectorSpec
from services.models.mission import MissionSpec
from services.models.outcome import Outcome
from services.recovery.reexecution import SCHEME

TWICE = DetectorSpec(scheme=SCHEME, gate="off", recovery="off")
"""Each output is made twice and compared, and the flight is what it is without: nobody acts on it."""


def watched(spec: MissionSpec, server: ForkServer) -> tuple[Series, str]:
    """Fly a mission, its fault too: what detectors see, with re-execution, and the flight's digest."""
    flight = fly(spec.model_copy(update={"detector": TWICE}), server, keep_messages=True)
    return series(spec, flight), flight.outcome.digest


def record(spec: MissionSpec, server: ForkServer) -> Series:
    """Fly a mission and keep what detectors would see; one with a fault beside its golden twin.

    :raises NothingToInjectError: if the twin never runs the fault's kernel.
    """
    if spec.fault is None:
        return series(spec, fly(spec, server, keep_messages=True))
    twin = fly(spec.model_copy(update={"fault": None}), server)
    fault = spec.fault.model_copy(update={"trigger": draw_call(spec.fault, twin.outcome)})
    flight = fly(spec.model_copy(update={"fault": fault}), server, keep_messages=True)
    made = series(spec, flight)
    nodes = compare(flight, twin).nodes.values()
    return Series(made.checks, {**made.about, "sdc": any(node.result == "sdc" for node in nodes)})


def series(spec: MissionSpec, flight: FlownMission) -> Series:
    """The checks of the mission ``spec``, flown with its messages kept.

    Perception and planning are asked for what they published. Control also for the waypoint that it
    tracked, which is on no topic: its follower is run again over what it had received. Its ticks after a
    restart are not distinguished, so a flight in which control died counts as if it had not.
    """
    messages, outcome = flight.messages, flight.outcome
    assert messages is not None  # noqa: S101 - asked for by the caller
    about: dict[str, Any] = {
        "spec": spec.model_dump(mode="json"),
        "result": outcome.result,
        "digest": outcome.digest,
        "time_s": max(times[-1] for times in flight.trace.times_ns.values() if times) / 1e9,
    }
    if outcome.injection is not None and outcome.injection.status == "injected":
        about["injected_s"] = outcome.injection.virtual_time_ns / 1e9
    if outcome.spec.detector == TWICE and outcome.detection is not None:
        about["differed_s"] = [alarm.virtual_time_ns / 1e9 for alarm in outcome.detection.alarms]
        about["kernels_s"] = _kernels_s(outcome)
    checks = {
        "perception": _perception(messages["collision_check"]),
        "planning": _planning(messages["trajectory"]),
        "control": _control(spec, messages),
    }
    return Series(checks, about)


def _kernels_s(outcome: Outcome) -> float:
    """The virtual time that the kernels of a flight took, at their mean on its platform."""
    latencies = load_platform(outcome.spec.platform).kernels
    uses = [use for stage in STAGES if stage in outcome.nodes for use in outcome.nodes[stage].kernels.items()]
    return sum(latencies[kernel].mean_ms * use.invocations for kernel, use in uses) / 1e3


def _perception(found: Sequence[Stamped]) -> Checks:
    rows = [shown_verdict(_read("collision_check", one)) for one in found]
    return Checks(_joined("perception", rows), np.arange(len(found)), _times(found))


def _planning(made: Sequence[Stamped]) -> Checks:
    """The rows as they were published, with the fault's effect, too, though the others may refuse it."""
    rows = [shown_trajectory(_read("trajectory", one)) for one in made]
    lengths = np.array([len(one) for one in rows], dtype=np.int64)
    return Checks(_joined("planning", rows), np.cumsum(lengths) - lengths, _times(made))


def _control(spec: MissionSpec, messages: Mapping[str, Sequence[Stamped]]) -> Checks:
    """The checks of control: runs the follower again, with each odometry message that was taken up."""
    # Stages are module names to those that deploy them.
    follower = importlib.import_module("services.control.following").follower(spec)
    sound = spec.message_checks
    rows, times = [], []
    checks, plans = iter(messages["collision_check"]), iter(messages["trajectory"])
    check, made = next(checks, None), next(plans, None)
    odometry = {one.ready_ns: one for one in messages["odometry"]}
    for sent in messages["command"]:
        command = _read("command", sent)
        tick = sent.ready_ns // TICK_NS * TICK_NS
        while check is not None and check.ready_ns <= tick:
            with suppress(MalformedMessageError):
                follower.take_verdict(*verdict(_read("collision_check", check), sound))
            check = next(checks, None)
        while made is not None and made.ready_ns <= tick:
            with suppress(MalformedMessageError):
                follower.take_trajectory(*plan(_read("trajectory", made), sound)[:3])
            made = next(plans, None)
        here = state(_read("odometry", odometry[tick]), sound)
        follower.curve(tick / 1e9, here.position, here.velocity, here.yaw)
        rows.append(shown_command(command, follower.curves, follower.tracked(tick / 1e9), here))
        times.append(tick / 1e9)
    return Checks(_joined("control", rows), 2 * np.arange(len(rows)), np.array(times))


def _joined(stage: str, rows: Sequence[Floats]) -> Floats:
    return np.concatenate([np.empty((0, len(WATCHED[stage]))), *rows])


def _times(messages: Sequence[Stamped]) -> Floats:
    return np.array([one.ready_ns / 1e9 for one in messages])


def _read(topic: str, message: Stamped) -> Any:
    return decode(message.payload, TOPICS[topic].type)
