"""How a mission ended, and its outcome from messages, alarms and the reports of its processes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from deploy.mission.listening import MissionBus
from deploy.mission.supervisor import SupervisedNode
from deploy.recording.recorder import FlightRecorder, FlightTrace
from services.bus.horizon import NEVER_NS, Stamped
from services.bus.messages import decode
from services.bus.topics import RECORDED, STAGES, TOPICS
from services.kernels import aimed_at, scope_of
from services.models.detection import DETECTOR
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec
from services.models.outcome import (
    NO_FLIGHT,
    InjectionRecord,
    MissionResult,
    NodeReport,
    NodeResult,
    Outcome,
    QoF,
)


@dataclass
class MissionEnd:
    """The result of a mission as soon as it is known, with its reason, quality of flight and virtual time."""

    result: MissionResult | None = None
    reason: str = ""
    qof: QoF = NO_FLIGHT
    time_ns: int = NEVER_NS
    seen: Stamped | None = None
    """The referee's newest message that has been looked at."""

    def look(self, recorder: FlightRecorder) -> None:
        """Take the result from the newest message of the referee, if it has decided."""
        last = recorder.last("mission")
        if last is self.seen or last is None or self.result is not None:
            return
        self.seen = last
        message = decode(last.payload, TOPICS["mission"].type)
        self.qof = QoF.model_validate_json(message.qof)
        if message.result != "flying":
            self.result = message.result
            self.time_ns = last.ready_ns

    def fail(self, reason: str, recorder: FlightRecorder) -> None:
        """End the mission with the last odometry, since an essential process died."""
        last = recorder.last("odometry")
        self.result = "stack_failure"
        self.reason = reason
        self.time_ns = last.ready_ns if last is not None else 0


def mission_outcome(
    spec: MissionSpec,
    end: MissionEnd,
    trace: FlightTrace,
    bus: MissionBus,
    members: Mapping[str, SupervisedNode],
    *,
    fixed_pids: bool,
) -> Outcome:
    """The outcome of a mission that has ended, all but its wall time."""
    assert end.result is not None  # noqa: S101 - it has ended
    fault, injection = spec.fault, bus.injection(end.time_ns)
    if fault is not None and injection is None:
        injection = _not_reached(fault)
    nodes = _reports(members, end.time_ns)
    if fault is not None and injection is not None and injection.trigger is not None:
        spec = spec.model_copy(update={"fault": fault.model_copy(update={"trigger": injection.trigger})})
    return Outcome(
        spec=spec,
        result=end.result,
        reason=end.reason,
        qof=end.qof,
        digest=trace.digest(),
        wall_s=0.0,
        nodes=nodes,
        topics={topic.name: trace.report(topic.name, None) for topic in RECORDED},
        injection=injection,
        detection=bus.alarms.report(spec, trace, end.time_ns, injection, nodes),
        refused_messages=bus.recorder.refused,
        recovered_messages=sum(int(member.stats.page["recovered"]) for member in members.values()),
        fixed_pids=fixed_pids,
    )


def _not_reached(fault: FaultSpec) -> InjectionRecord:
    return InjectionRecord(
        status="not_reached",
        reason="the flight ended before that call or message",
        node=aimed_at(fault),
        kernel=fault.target if fault.level == "instruction" else "",
        invocation=(fault.trigger.invocation if fault.trigger is not None else None) or 0,
        model=fault.model,
        scope=scope_of(fault),
    )


def _reports(members: Mapping[str, SupervisedNode], end_ns: int) -> dict[str, NodeReport]:
    def result(member: SupervisedNode) -> NodeResult:
        if member.hangs:
            return "hang"
        return "crash" if member.crashes else "golden"

    reported = (*STAGES, DETECTOR)
    return {
        name: member.report(result(member), end_ns) for name, member in members.items() if name in reported
    }
