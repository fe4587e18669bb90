"""Pairing: every injected flight has a golden twin, the same flight without the fault.

The twin serves three ends: the moment of the fault is drawn over what it computed, the statistics are
paired with it, and what differs from it is silent data corruption.
"""

from __future__ import annotations

from collections import OrderedDict

from deploy.forkserver import ForkServer
from deploy.mission import Flight, fly
from services.bus import rng
from services.bus.mission import FaultSpec, MissionSpec, Trigger
from services.bus.outcome import GoldenTwin, NodeReport, Outcome
from services.bus.states import members
from services.bus.topics import RECORDED, published_by
from services.kernels import KERNELS

TWINS_KEPT = 16


class NothingToInjectError(ValueError):
    """The golden twin never ran the kernel that the fault is aimed at."""


class Pairs:
    """Flies missions, each faulty one beside its golden twin; a twin flies once for all its faults."""

    def __init__(self, server: ForkServer) -> None:
        self._server = server
        self._twins: OrderedDict[str, Flight] = OrderedDict()

    def fly(self, spec: MissionSpec) -> Outcome:
        """The outcome of ``spec``; with a fault, compared with its golden twin.

        :raises NothingToInjectError: if the twin never runs the fault's kernel.
        """
        if spec.fault is None:
            return self._golden(spec).outcome
        twin = self._golden(spec.model_copy(update={"fault": None}))
        fault = spec.fault
        if fault.trigger is None:
            fault = fault.model_copy(update={"trigger": draw_trigger(fault, twin.outcome)})
        return compare(fly(spec.model_copy(update={"fault": fault}), self._server), twin)

    def _golden(self, spec: MissionSpec) -> Flight:
        key = spec.model_dump_json()
        if key not in self._twins:
            self._twins[key] = fly(spec, self._server)
            if len(self._twins) > TWINS_KEPT:
                self._twins.popitem(last=False)
        return self._twins[key]


def draw_trigger(fault: FaultSpec, golden: Outcome) -> Trigger:
    """Draw when the fault strikes: a call of the kernel, and a moment of thread time within it; or a
    message that carries the state, uniform over those of the golden twin.

    The call is uniform over the golden twin's calls. The moment is uniform over the mean thread time
    of a call, which differs a little from machine to machine: the record says ``cpu_time``.

    :raises NothingToInjectError: if the golden twin never ran the kernel.
    """
    draw = rng.generator(golden.spec.seed, f"trigger {fault.target}", fault.seed)
    if fault.level == "source":
        messages = golden.topics[members(fault.target)[0].topic].messages
        if not messages:
            message = f"the golden flight never publishes {fault.target}: nothing to inject into"
            raise NothingToInjectError(message)
        return Trigger(invocation=int(draw.integers(messages)), cpu_ns=0)
    use = golden.nodes[KERNELS[fault.target].stage].kernels.get(fault.target)
    if use is None:
        message = f"the golden flight never runs {fault.target}: nothing to inject into"
        raise NothingToInjectError(message)
    invocation = int(draw.integers(use.invocations))
    return Trigger(invocation=invocation, cpu_ns=int(draw.random() * use.cpu_ns / use.invocations))


def compare(flight: Flight, twin: Flight) -> Outcome:
    """The faulty flight's outcome with what its golden twin tells: divergence, benign or SDC.

    In real time no two flights have the same messages: there the twin tells of quality only.
    """
    repeats = flight.outcome.spec.clock == "lockstep"
    pair = twin.trace if repeats else None
    topics = {topic.name: flight.trace.report(topic.name, pair) for topic in RECORDED}

    def judged(stage: str, report: NodeReport) -> NodeReport:
        if report.result in ("crash", "hang"):
            return report
        if not repeats:
            return report.model_copy(update={"result": "unpaired"})
        strayed = any(topics[topic.name].diverged_at_s is not None for topic in published_by(stage))
        return report.model_copy(update={"result": "sdc" if strayed else "benign"})

    golden = twin.outcome
    return flight.outcome.model_copy(
        update={
            "topics": topics,
            "nodes": {stage: judged(stage, report) for stage, report in flight.outcome.nodes.items()},
            "golden": GoldenTwin(result=golden.result, qof=golden.qof, digest=golden.digest),
        }
    )
