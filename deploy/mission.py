"""Fly one mission: start its processes, keep its messages, answer for its dead, tell its outcome."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from deploy.alarms import Alarms
from deploy.forkserver import ForkServer
from deploy.mould import EXIT_BUG
from deploy.platform import check_latency, load_platform
from deploy.recorder import Recorder, Trace
from deploy.scratch import mission_folder
from deploy.settling import EVENTS, Sent, Settling
from deploy.supervisor import InfrastructureError, Member, Supervisor
from deploy.tape import Tap
from services.bus import session
from services.bus.clock import FlightClock
from services.bus.courier import LIFE_SHIFT
from services.bus.horizon import NEVER_NS, Stamped
from services.bus.messages import Alarm, Horizon, Injection, MalformedMessageError, decode, encode
from services.bus.mission import MissionSpec, Trigger
from services.bus.node import DETECTOR, NodeSetup
from services.bus.outcome import (
    NO_FLIGHT,
    InjectionRecord,
    MissionResult,
    NodeReport,
    NodeResult,
    Outcome,
    QoF,
    repeatable,
)
from services.bus.topics import HORIZON_TYPE, RECORDED, STAGES, TOPICS
from services.kernels import KERNELS, aimed_at

LOOK_S = 0.02
"""Wall time between two looks at the processes while no message comes."""

STALL_S = 20.0
"""Wall time without a message or promise after which somebody must be hanging outside a step."""

GRACE_S = 2.0
BURIAL_S = 2.0
"""Longest wait for the end of a detector that is known to be dead."""


@dataclass(frozen=True, slots=True)
class Flight:
    """An outcome with the trace that a golden twin is compared by, and the messages if they were kept."""

    outcome: Outcome
    trace: Trace
    messages: Mapping[str, Sequence[Stamped]] | None = None
    late: int = 0


Watch = Callable[[MissionSpec, Recorder], None]
"""Is given the recorder of each flight as it begins, to look into from another thread."""


def fly(
    spec: MissionSpec,
    server: ForkServer,
    *,
    keep_messages: bool = False,
    watch: Watch | None = None,
    taps: Sequence[Tap] = (),
) -> Flight:
    """Fly one mission on a fork server; a pure function of ``spec`` as far as virtual time goes.

    ``keep_messages`` gives the caller every recorded message up to the end of the mission, by topic; ``taps``
    are given the same meanwhile, and injection and alarms, in the order of virtual time.

    :raises InfrastructureError: if we failed. A crashed vehicle or node returns normally.
    """
    return _Mission(spec, server, watch, taps).fly(keep_messages=keep_messages)


def as_stages_know_it(spec: MissionSpec) -> MissionSpec:
    """The specification with no more of the struck call than names it.

    A replay knows the instruction, too, but its nodes must begin with the same memory as the first time.
    """
    fault = spec.fault
    if fault is None or fault.trigger is None or fault.level != "instruction":
        return spec
    after_ns = fault.trigger.after_ns
    call = Trigger(after_ns=after_ns, invocation=fault.trigger.invocation if after_ns is None else None)
    return spec.model_copy(update={"fault": fault.model_copy(update={"trigger": call})})


class _Mission:
    def __init__(
        self, spec: MissionSpec, server: ForkServer, watch: Watch | None, taps: Sequence[Tap]
    ) -> None:
        self._spec = spec
        self._server = server
        self._recorder = Recorder()
        self._taps = taps
        told = spec.fault is not None or spec.detector is not None
        self._settling = Settling(self._recorder, held=told, realtime=spec.clock == "realtime")
        if watch is not None:
            watch(spec, self._recorder)
        self._events: queue.SimpleQueue[tuple[Callable[[Any], None], Any]] = queue.SimpleQueue()
        self._injection: InjectionRecord | None = None
        self._alarms = Alarms()
        self._horizons: dict[str, zenoh.Publisher] = {}
        self._result: MissionResult | None = None
        self._reason = ""
        self._qof: QoF | None = None
        self._end_ns = NEVER_NS
        self._last_word = 0.0
        self._clock: Path | None = None

    def fly(self, *, keep_messages: bool) -> Flight:
        begin = time.monotonic()
        flight = self._flown(keep_messages=keep_messages)
        # All that a flight takes, its end included.
        outcome = flight.outcome.model_copy(update={"wall_s": time.monotonic() - begin})
        return replace(flight, outcome=outcome)

    def _flown(self, *, keep_messages: bool) -> Flight:
        with mission_folder() as folder:
            meeting = session.Meeting(folder, f"zenfi/{folder.name}")
            if self._spec.clock == "realtime":
                FlightClock.create(meeting.clock)
                self._clock = meeting.clock
            with session.open_session(meeting, "router", router=True) as bus:
                self._listen(bus)
                self._supervisor = Supervisor(self._server, meeting, self._spec.limits.hang_cpu_s)
                try:
                    self._start_all()
                    self._until_ended()
                    self._answered_for()
                    self._supervisor.end(GRACE_S, lambda: self._take_in(0.001))
                    if self._server.is_lost():  # and has taken with it what nodes had still to count
                        raise InfrastructureError("the fork server was lost in mid flight")
                    self._pass_on(self._settling.rest(self._end_ns))
                    trace = self._recorder.trace(self._end_ns)
                    outcome = self._outcome(trace)
                    messages = self._recorder.until(self._end_ns) if keep_messages else None
                    return Flight(outcome, trace, messages, self._settling.late)
                finally:
                    self._supervisor.close()

    # -- starting ----------------------------------------------------------------------------------

    def _listen(self, bus: zenoh.Session) -> None:
        def subscribe(key: str, handle: Callable[[Any], None]) -> Any:
            return bus.declare_subscriber(
                key, session.hand_over(lambda sample: self._events.put((handle, sample)))
            )

        self._declared = [
            subscribe(session.topic_key(topic.name), self._recording(topic.name)) for topic in RECORDED
        ]
        self._declared += [subscribe(session.horizon_key(stage), self._hearing(stage)) for stage in STAGES]
        self._declared.append(subscribe(session.topic_key("injection"), self._take_injection))
        self._declared.append(
            bus.declare_queryable(
                f"{session.HISTORY_KEY}/**",
                session.hand_over(lambda query: self._events.put((self._answer, query))),
            )
        )
        self._declared.append(
            bus.declare_queryable(
                session.alarm_key("*"),
                session.hand_over(lambda query: self._events.put((self._take_alarm, query))),
            )
        )
        self._horizons = {stage: bus.declare_publisher(session.horizon_key(stage)) for stage in STAGES}

    def _recording(self, topic: str) -> Callable[[Any], None]:
        def handle(sample: zenoh.Sample) -> None:
            self._last_word = time.monotonic()
            try:
                self._recorder.record(topic, session.stamped(sample))
            except MalformedMessageError:
                self._recorder.malformed += 1

        return handle

    def _hearing(self, stage: str) -> Callable[[Any], None]:
        def handle(sample: zenoh.Sample) -> None:
            self._last_word = time.monotonic()
            self._recorder.hear(stage, sample.payload.to_bytes())

        return handle

    def _take_injection(self, sample: zenoh.Sample) -> None:
        message = decode(sample.payload.to_bytes(), TOPICS["injection"].type)
        record = self._injection = InjectionRecord.model_validate_json(message.record)
        told = Injection(record=repeatable(record).model_dump_json(by_alias=True))
        self._settling.tell("injection", record.virtual_time_ns, encode(told, TOPICS["injection"].type))

    def _take_alarm(self, query: zenoh.Query) -> None:
        alarm = self._alarms.take(query)
        if alarm is not None:
            told = Alarm(record=alarm.model_dump_json())
            self._settling.tell("alarm", alarm.virtual_time_ns, encode(told, EVENTS["alarm"]))

    def _pass_on(self, batch: Sequence[Sent]) -> None:
        for tap in self._taps if batch else ():
            tap.offer(batch)

    def _answer(self, query: zenoh.Query) -> None:
        """Give a node the messages that it missed."""
        with query:
            key = str(query.key_expr)
            topic = key.removeprefix(f"{session.HISTORY_KEY}/")
            if topic.startswith("horizon/"):
                promise = self._recorder.horizon(topic.removeprefix("horizon/"))
                if promise is not None:
                    query.reply(key, promise)
                return
            first = int(query.payload.to_bytes()) if query.payload is not None else 0
            for message in self._recorder.since(topic, first):
                gid = session.publisher_gid(TOPICS[topic].publisher, topic)
                query.reply(
                    key, message.payload, attachment=session.attach(message.seq, message.ready_ns, gid)
                )

    def _start_all(self) -> None:
        fault = self._spec.fault
        injector_needed = fault is not None and fault.level == "instruction"
        detector = self._spec.detector
        processes = [
            one
            for one in self._server.stack.values()
            if (injector_needed or not one.with_fault) and (detector is not None or not one.with_detector)
        ]
        self._expected = [process.name for process in processes]
        self._latencies = load_platform(self._spec.platform).kernels
        if detector is not None:
            check = check_latency(self._spec.platform, detector)
            self._latencies = {**self._latencies, DETECTOR: check}
        if self._spec.stack is not None:
            for stage, own in self._spec.stack.stages.items():
                self._latencies = {**self._latencies, stage: own.latency}
        for process in processes:
            self._supervisor.start(process, self._setup(process.name))

    def _setup(self, name: str) -> NodeSetup:
        sidecar = self._server.stack[name].sidecar
        return NodeSetup(
            name=name,
            spec=self._spec if sidecar else as_stages_know_it(self._spec),
            kernels=self._kernels(name),
            latencies=self._latencies,
            expected=self._expected,
            clock=self._clock,
        )

    def _kernels(self, name: str) -> list[str]:
        """What is counted and timed in a node: of the detector its scheme, of an executable all it does."""
        if name == DETECTOR and self._spec.detector is not None:
            return [self._spec.detector.scheme]
        if self._spec.own_stage(name) is not None:
            return [name]
        return [kernel.name for kernel in KERNELS.values() if kernel.stage == name]

    # -- flying ------------------------------------------------------------------------------------

    def _until_ended(self) -> None:
        """Take in messages and look after the processes until all up to the mission's end is recorded."""
        last_look = self._last_word = time.monotonic()
        while self._result is None or not self._recorder.complete(self._end_ns):
            if self._take_in(LOOK_S):
                self._look_for_end()
                if self._taps:
                    self._pass_on(self._settling.take(self._end_ns))
            if time.monotonic() - last_look > LOOK_S:
                last_look = time.monotonic()
                self._bury_and_revive()
                self._supervisor.kill_hung()
                if last_look - self._last_word > STALL_S:
                    self._stalled()
                    self._last_word = last_look
            if self._result == "stack_failure":
                return

    def _take_in(self, timeout_s: float) -> bool:
        try:
            handle, sample = self._events.get(timeout=timeout_s)
        except queue.Empty:
            return False
        handle(sample)
        while not self._events.empty():
            handle, sample = self._events.get()
            handle(sample)
        return True

    def _look_for_end(self) -> None:
        last = self._recorder.last("mission")
        if last is None or self._result is not None:
            return
        message = decode(last.payload, TOPICS["mission"].type)
        self._qof = QoF.model_validate_json(message.qof)
        if message.result != "flying":
            self._result = message.result
            self._end_ns = last.ready_ns

    def _stalled(self) -> None:
        if any(one.alive and one.vitals.page["gated"] for one in self._supervisor.members.values()):
            return  # scouts are under way; should the injector die of it, that is heard of
        if any(one.alive and one.vitals.page["asking"] for one in self._supervisor.members.values()):
            # It hangs without computing, as when it was stopped: the stage that asks would wait for ever.
            self._supervisor.kill_as_hung(self._supervisor.members[DETECTOR])
            return
        fault = self._spec.fault
        if fault is None or not self._supervisor.members[aimed_at(fault)].alive:
            tails = "; ".join(
                f"{one.process.name}: {one.log_tail}" for one in self._supervisor.members.values()
            )
            message = f"nobody said anything for {STALL_S:.0f} s ({tails})"
            raise InfrastructureError(message)
        self._supervisor.kill_as_hung(self._supervisor.members[aimed_at(fault)])

    # -- dying -------------------------------------------------------------------------------------

    def _bury_and_revive(self) -> None:
        for member, exited in self._supervisor.deaths():
            name = member.process.name
            if exited.status == 0:
                continue
            if exited.status == EXIT_BUG and (self._spec.fault is None or member.process.essential):
                message = f"{name}: {member.log_tail}"
                raise InfrastructureError(message)
            if name == "injector":
                message = f"the injector died: {member.causes[-1]}"
                raise InfrastructureError(message)
            if member.process.with_detector:
                continue  # the stages go on without verdicts
            self._look_for_end()
            if member.process.essential:
                self._fail(name, member)
            else:
                self._replace(member)

    def _fail(self, name: str, member: Member) -> None:
        last = self._recorder.last("odometry")
        self._result = "stack_failure"
        self._reason = f"{name}: {member.causes[-1]}"
        self._end_ns = last.ready_ns if last is not None else 0

    def _replace(self, member: Member) -> None:
        """Say on a dead node's behalf how long it will be silent, and start it again, if it may be."""
        stage, limits = member.process.name, self._spec.limits
        silent_until = self._recorder.silent_until_ns(stage)
        died_ns = int(member.vitals.page["step_ns"])
        # After the end nobody is started again, but who waits for this stage must hear that it is silent.
        may_restart = member.life < limits.restarts and self._result is None
        start_ns = (
            max(silent_until, died_ns + round(limits.restart_delay_s * 1e9)) if may_restart else NEVER_NS
        )
        self._promise_for(stage, member.life + 1, start_ns)
        if may_restart:
            members = self._supervisor.members
            setup = self._setup(stage).model_copy(
                update={
                    "expected": [name for name in self._expected if members[name].alive or name == stage],
                    "life": member.life + 1,
                    "start_ns": start_ns,
                    "published": self._recorder.published(stage),
                    "resume_from": self._recorder.resume_from(start_ns),
                }
            )
            self._supervisor.start(member.process, setup)

    def _promise_for(self, stage: str, life: int, start_ns: int) -> None:
        counts = list(self._recorder.published(stage).values())
        message = Horizon(
            serial=life << LIFE_SHIFT,
            # Older triggers are settled: the new life will not know them. Later ones await it.
            accepted_ns=start_ns - 1,
            busy_until_ns=start_ns,
            until_ns=np.full(len(counts), start_ns, dtype=np.int64),
            count=np.array(counts, dtype=np.uint64),
        )
        payload = encode(message, HORIZON_TYPE)
        self._recorder.hear(stage, payload)
        self._horizons[stage].put(payload)

    def _answered_for(self) -> None:
        """See to it that a detector of which verdicts are missing is known to have died.

        :raises InfrastructureError: if it lives: then questions got lost, and that is our failure.
        """
        members = self._supervisor.members
        ungated = sum(int(one.vitals.page["ungated"]) for one in members.values())
        deadline = time.monotonic() + BURIAL_S
        while ungated and members[DETECTOR].alive:
            if time.monotonic() > deadline:
                message = f"{ungated} questions to the detector, which lives, were not answered"
                raise InfrastructureError(message)
            self._take_in(LOOK_S)
            self._bury_and_revive()

    # -- telling -----------------------------------------------------------------------------------

    def _outcome(self, trace: Trace) -> Outcome:
        """All but its wall time."""
        assert self._result is not None  # noqa: S101 - the loop ends with a result
        fault, injection = self._spec.fault, self._injection
        if fault is not None and injection is None:
            injection = InjectionRecord(
                status="not_reached",
                reason="the flight ended before that call or message",
                node=aimed_at(fault),
                kernel=fault.target if fault.level == "instruction" else "",
                invocation=(fault.trigger.invocation if fault.trigger is not None else None) or 0,
                model=fault.model,
                scope=fault.scope,
            )
        spec, nodes = self._spec, self._reports()
        if fault is not None and injection is not None and injection.trigger is not None:
            spec = spec.model_copy(update={"fault": fault.model_copy(update={"trigger": injection.trigger})})
        return Outcome(
            spec=spec,
            result=self._result,
            reason=self._reason,
            qof=self._qof if self._qof is not None else NO_FLIGHT,
            digest=trace.digest(),
            wall_s=0.0,
            nodes=nodes,
            topics={topic.name: trace.report(topic.name, None) for topic in RECORDED},
            injection=injection,
            detection=self._alarms.report(spec, trace, self._end_ns, injection, nodes),
            refused_messages=self._recorder.refused,
            recovered_messages=sum(
                int(m.vitals.page["recovered"]) for m in self._supervisor.members.values()
            ),
            fixed_pids=self._server.fixed_pids,
        )

    def _reports(self) -> dict[str, NodeReport]:
        def result(member: Member) -> NodeResult:
            if member.hangs:
                return "hang"
            return "crash" if member.crashes else "golden"

        members = self._supervisor.members
        told = (*STAGES, DETECTOR)
        return {name: member.report(result(member)) for name, member in members.items() if name in told}
