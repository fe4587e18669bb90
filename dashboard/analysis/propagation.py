"""Error propagation from two recordings: what strayed, how it grew, and through what it passed on."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from pydantic import Field

from dashboard.analysis.recordings_reader import FlightRecording
from deploy.config.check import check
from deploy.errors import BadSpecError
from deploy.mission.flight import fly
from deploy.mission.fork_server import ForkServer
from deploy.recording.propagation import FAULT, growth, propagation, unit
from services.models.base import Strict
from services.models.propagation import Propagation


class Edge(Strict):
    """One way by which the error may have passed on: from a topic, or `fault`, to one that strayed later."""

    source: str
    target: str
    delay_ns: int


class Growth(Strict):
    """How far a topic was from the twin's, message by message; None where no number says it."""

    topic: str
    unit: str
    time_s: list[float]
    deviation: list[float | None]


class Picture(Strict):
    """All that a page needs to draw it."""

    propagation: Propagation
    edges: list[Edge] = Field(description="in the order of time")
    growth: list[Growth] = Field(description="of the topics that strayed and have a measure, in that order")


def between(run: FlightRecording, twin: FlightRecording) -> Propagation:
    """How the error in ``run`` passed on.

    :raises BadSpecError: if ``twin`` is not its golden twin, or either is not complete.
    """
    _pair(run, twin)
    return propagation(run.flight, twin.flight, run.injection)


def picture(run: FlightRecording, twin: FlightRecording) -> Picture:
    """The same with its ways and how far each topic strayed.

    :raises BadSpecError: as :func:`between` does.
    """
    found = between(run, twin)
    grown = []
    for strayed in found.topics:
        if not unit(strayed.topic):
            continue
        points = growth(strayed.topic, run.flight, twin.flight)
        grown.append(
            Growth(
                topic=strayed.topic,
                unit=unit(strayed.topic),
                time_s=[one.at_ns / 1e9 for one in points],
                deviation=[one.deviation for one in points],
            )
        )
    return Picture(propagation=found, edges=edges(found), growth=grown)


def with_flown_twin(run: FlightRecording) -> FlightRecording:
    """The golden twin of ``run``, flown now.

    :raises BadSpecError: if it has none, or the file does not say what was flown.
    """
    spec = run.spec
    check(spec)
    if spec.fault is None:
        message = f"{run.path}: a flight without a fault is its own twin"
        raise BadSpecError(message)
    golden = spec.model_copy(update={"fault": None})
    with closing(ForkServer()) as server:
        flown = fly(golden, server, keep_messages=True)
    about = {"spec": golden.model_dump_json()}
    messages = {topic: list(sent) for topic, sent in (flown.messages or {}).items()}
    return FlightRecording(Path("its golden twin"), complete=True, about=about, messages=messages)


def to_dot(found: Propagation, ways: Sequence[Edge]) -> str:
    """The graph as Graphviz reads it: topics with the time at which they strayed, ways with their delay."""
    lines = ["digraph propagation {", "  rankdir=LR; node [shape=box, fontname=sans-serif];"]
    if found.struck_at_ns is not None:
        place = f"{found.struck_stage}\\n{found.struck_at_ns / 1e9:.3f} s"
        lines.append(f'  "{FAULT}" [label="fault in {place}", shape=octagon, color=red];')
    lines += [f'  "{one.topic}" [label="{one.topic}\\n{one.at_ns / 1e9:.3f} s"];' for one in found.topics]
    lines += [f'  "{way.source}" -> "{way.target}" [label="{way.delay_ns / 1e6:.1f} ms"];' for way in ways]
    return "\n".join([*lines, "}", ""])


def edges(found: Propagation) -> list[Edge]:
    """From each cause to what it may have made stray."""
    began = {one.topic: one.at_ns for one in found.topics}
    if found.struck_at_ns is not None:
        began[FAULT] = found.struck_at_ns
    made = [
        Edge(source=cause, target=one.topic, delay_ns=one.at_ns - began[cause])
        for one in found.topics
        for cause in one.causes
    ]
    return sorted(made, key=lambda edge: began[edge.target])


def _pair(run: FlightRecording, twin: FlightRecording) -> None:
    for one in (run, twin):
        if not one.complete:
            message = f"{one.path}: the flight was killed: only whole flights can be compared"
            raise BadSpecError(message)
    faulty, golden = run.spec, twin.spec
    if golden.fault is not None or faulty.model_copy(update={"fault": None}) != golden:
        message = f"{twin.path}: not the golden twin of {run.path}: its specification is another"
        raise BadSpecError(message)
    if faulty.clock == "realtime":
        message = f"{run.path}: a flight in real time does not repeat: it has no twin"
        raise BadSpecError(message)
