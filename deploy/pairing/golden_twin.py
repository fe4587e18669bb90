"""Pairing: every injected flight has a golden twin, the same flight without the fault.

The twin serves three ends: the moment of the fault is drawn over what it computed, the statistics are
paired with it, and what differs from it is silent data corruption.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from deploy.errors import DisturbedFlightError
from deploy.mission.flight import FlownMission, Watch, fly
from deploy.mission.fork_server import ForkServer
from deploy.mission.judgement import judge_harm, judge_properties, judge_recovery
from deploy.pairing.idle_guards import IdleGuards
from deploy.pairing.proofs import FlightProofs, as_twin, can_be_proven, has_proofs, may_stand_for_others
from deploy.recording.live_feed import LiveFeed
from deploy.recording.mcap_recorder import McapRecorder, MessageTap
from deploy.recording.propagation import propagation
from injector.strikes.results import StrikeRecord
from services.bus.topics import RECORDED, published_by
from services.kernels import aimed_at
from services.models.faults.specification import FaultSpec, Trigger
from services.models.inter_kernel_states import members
from services.models.mission import MissionSpec
from services.models.outcome import GoldenTwin, InjectionRecord, NodeReport, Outcome
from services.models.pilots import numbered
from services.runtime import rng

TWINS_KEPT = 16


class NothingToInjectError(ValueError):
    """The golden twin never ran the kernel that the fault is aimed at."""


class PairFlyer:
    """Flies missions, each faulty one beside its golden twin; a twin flies once for all its faults."""

    def __init__(self, server: ForkServer, watch: Watch | None = None) -> None:
        self._server = server
        self._watch = watch
        self._live: Path | None = None
        self._twins: OrderedDict[str, FlownMission] = OrderedDict()
        self.proofs = FlightProofs(server)
        self.idle_guards = IdleGuards(self.proofs.flown, server)

    def fly(
        self,
        spec: MissionSpec,
        record: Path | None = None,
        about: Mapping[str, str] | None = None,
        live: Path | None = None,
        ahead: Sequence[FaultSpec] | None = None,
    ) -> Outcome:
        """The outcome of ``spec``; with a fault, compared with its golden twin.

        Recorded to a file, if one is named, with what ``about`` says; then it also says how the error
        propagated. ``live`` is the socket of who shows flights while they are flown.

        :raises NothingToInjectError: if the twin never runs the fault's kernel.
        :raises DisturbedFlightError: if a process was ended from outside, or dies without a fault, or if an
            instruction that was drawn was missed.
        """
        self._live = live
        if spec.fault is None:
            if record is None:
                return self._golden(spec).outcome
            with McapRecorder(record, spec, about) as recording:
                return _with_report(self._golden(spec, recording), recording).outcome
        may_prove = ahead is not None and record is None and has_proofs(spec)
        asked = spec  # before its call is drawn
        known = self.idle_guards.known(asked) if may_prove else None
        if known is not None:
            return known
        twin = self._golden(spec.model_copy(update={"fault": None}), keep=record is not None or may_prove)
        fault = _at_a_call(spec.fault, twin)
        spec = spec.model_copy(update={"fault": fault})
        if may_prove and can_be_proven(fault) and may_stand_for_others(twin):
            return self._proven_or_flown(spec, twin, [_at_a_call(one, twin) for one in ahead or ()])
        if record is None:
            flown = self._fly(spec)
        else:
            with McapRecorder(record, spec, about) as recording:
                flown = _with_report(self._fly(spec, recording), recording)
        require_drawn_instruction(spec, flown.outcome.injection)
        outcome = compare(flown, twin)
        if may_prove:
            self.idle_guards.keep(asked, outcome)
        return outcome

    def _proven_or_flown(self, spec: MissionSpec, twin: FlownMission, ahead: Sequence[FaultSpec]) -> Outcome:
        """The outcome of a fault: known by what the fault does to its node alone, or flown."""
        assert spec.fault is not None  # noqa: S101 - asked for by who has one
        found = self.proofs.strike(twin, spec.fault, ahead)
        known = self.proofs.known(spec, found)
        if known is not None:
            return known
        flight = as_twin(spec, twin, found)
        if flight is not None:
            return compare(flight, twin)
        flown = self._fly(_where_it_struck(spec, found))
        require_drawn_instruction(spec, flown.outcome.injection)
        outcome = compare(flown, twin)
        self.proofs.keep(spec, outcome, found)
        return outcome

    def _golden(
        self, spec: MissionSpec, recording: McapRecorder | None = None, *, keep: bool = False
    ) -> FlownMission:
        key, keep = spec.model_dump_json(), keep or recording is not None
        known = self._twins.get(key)
        if known is not None and known.messages is not None and recording is not None:
            recording.copy(known.messages)
        elif known is None or (keep and known.messages is None):
            flown = self._fly(spec, *([] if recording is None else [recording]), keep=keep)
            _require_no_death(flown.outcome)
            self._twins[key] = flown
            if len(self._twins) > TWINS_KEPT:
                self._twins.popitem(last=False)
        return self._twins[key]

    def _fly(self, spec: MissionSpec, *taps: MessageTap, keep: bool = False) -> FlownMission:
        keep = keep or bool(taps)
        with ExitStack() as stack:
            if self._live is not None:
                taps = (*taps, stack.enter_context(LiveFeed(self._live, spec)))
            return fly(spec, self._server, keep_messages=keep, watch=self._watch, taps=taps)


def _at_a_call(fault: FaultSpec, twin: FlownMission) -> FaultSpec:
    """The fault with the call or message that it strikes, drawn if it names none."""
    if fault.trigger is not None and fault.trigger.names_a_call:
        return fault
    return fault.model_copy(update={"trigger": draw_call(fault, twin.outcome)})


def _where_it_struck(spec: MissionSpec, found: StrikeRecord) -> MissionSpec:
    """The mission with the instruction that the node alone was struck at: it need not be drawn again."""
    assert spec.fault is not None  # noqa: S101 - it was struck with
    if found.injection is None or found.injection.status != "injected":
        return spec
    fault = spec.fault.model_copy(update={"trigger": found.injection.trigger})
    return spec.model_copy(update={"fault": fault})


def _require_no_death(golden: Outcome) -> None:
    """Nothing in a golden flight explains a death, so there is something from outside, or a bug.

    :raises DisturbedFlightError: if a process has died.
    """
    for name, report in golden.nodes.items():
        if report.causes:
            message = f"{name} died in a flight without a fault: {report.causes[0]}"
            raise DisturbedFlightError(message)


def require_drawn_instruction(spec: MissionSpec, record: InjectionRecord | None) -> None:
    """Refuse a flight whose call ended without the instruction that a copy of the call had executed.

    The node does the same as its copy, so it is we who missed it: the kernel or a hypervisor may lose a
    breakpoint. Where the specification names the instruction, that is a result: it may not be there. So it is
    of a program of somebody's own, which need not do the same as its copy.

    :raises DisturbedFlightError: if that is so.
    """
    fault = spec.fault
    if record is None or fault is None or spec.own_stage(aimed_at(fault)) is not None:
        return
    was_named = fault.trigger is not None and fault.trigger.site is not None
    was_drawn = not was_named and record.trigger is not None and record.trigger.site is not None
    if was_drawn and record.status in ("not_reached", "diverged"):
        message = f"a copy of the call executed the drawn instruction, but the call did not: {record.reason}"
        raise DisturbedFlightError(message)


def _with_report(flight: FlownMission, recording: McapRecorder) -> FlownMission:
    """The flight with the report of its recording."""
    report = recording.finish(flight.outcome).model_copy(update={"late": flight.late})
    return replace(flight, outcome=flight.outcome.model_copy(update={"recording": report}))


def draw_call(fault: FaultSpec, golden: Outcome) -> Trigger:
    """Draw the call or message in which the fault strikes, over the golden twin's or its flight time.

    :raises NothingToInjectError: if the golden twin never ran the kernel.
    """
    if fault.recurs:
        return Trigger(after_ns=round(fault.from_s * 1e9))
    calls = fault.trigger.calls if fault.trigger is not None else None
    seed = fault.seed if calls is None else fault.seed % calls
    draw = rng.generator(golden.spec.seed, f"trigger {fault.target}", seed)
    if fault.level == "source":
        messages = golden.topics[members(fault.target)[0].topic].messages
        if not messages:
            message = f"the golden flight never publishes {fault.target}: nothing to inject into"
            raise NothingToInjectError(message)
        return _drawn(fault, golden, draw, messages)
    use = golden.nodes[aimed_at(fault)].kernels.get(fault.target)
    if use is None:
        message = f"the golden flight never runs {fault.target}: nothing to inject into"
        raise NothingToInjectError(message)
    trigger = _drawn(fault, golden, draw, use.invocations)
    if golden.spec.clock == "realtime" and trigger.site is None and trigger.cpu_ns is None:
        # No probes are sent ahead: meanwhile the flight would go on.
        mean_ns = use.cpu_ns / use.invocations
        trigger = trigger.model_copy(update={"cpu_ns": int(draw.random() * mean_ns)})
    return trigger


def _drawn(fault: FaultSpec, golden: Outcome, draw: np.random.Generator, times: int) -> Trigger:
    """The trigger with one of so many calls or messages, or a moment of the flight."""
    wanted = fault.trigger if fault.trigger is not None else Trigger()
    if wanted.over == "time":
        moment = {"after_ns": int(draw.random() * golden.qof.flight_time_s * 1e9)}
    else:
        moment = {"invocation": int(draw.integers(times))}
    return wanted.model_copy(update=moment)


def compare(flight: FlownMission, twin: FlownMission) -> Outcome:
    """The faulty flight's outcome compared with its golden twin: divergence, benign or SDC, and harm.

    In real time no two flights have the same messages: there only the qualities of flight are compared.
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
    passed_on = None
    if repeats and flight.messages is not None and twin.messages is not None:
        passed_on = propagation(flight.messages, twin.messages, flight.outcome.injection)
    properties = judge_properties(golden.spec, flight.true_path, twin.true_path)
    outcome = flight.outcome.model_copy(update={"properties": properties})
    return outcome.model_copy(
        update={
            "topics": topics,
            "nodes": {stage: judged(stage, report) for stage, report in flight.outcome.nodes.items()},
            "golden": GoldenTwin(
                result=golden.result,
                qof=golden.qof,
                digest=golden.digest,
                guards=tuple(name for name in numbered(golden.acting_guards) if name in golden.acting_guards),
            ),
            "propagation": passed_on,
            "detection": judge_recovery(outcome.detection, flight.true_path, twin.true_path),
            "harm": judge_harm(outcome, golden, flight.end_ns),
        }
    )
