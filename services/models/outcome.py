"""The outcome of a mission: the one definition of its result, metrics and records."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from services.models.base import Strict
from services.models.detection import DetectionReport
from services.models.faults.specification import FaultModel, Trigger
from services.models.mission import MissionSpec
from services.models.oracles.harm import HarmEvent
from services.models.oracles.properties import PropertyResult
from services.models.pilots import Guards
from services.models.propagation import Propagation

MissionResult = Literal["success", "collision", "no_path", "timeout", "stack_failure"]
NodeResult = Literal["golden", "benign", "sdc", "unpaired", "crash", "hang"]
"""Of a node that lived: what its messages are beside its golden twin's. Flights in real time have none."""


class QoF(Strict):
    """Quality of flight: success, time, distance, energy and clearance of one flight."""

    success: bool
    flight_time_s: float
    distance_m: float
    energy_kj: float
    state_of_charge: float = Field(description="of the battery at the end, a part of one")
    missions_per_charge: float = Field(description="such flights that a full battery holds; 0 if it failed")
    replans: int
    min_clearance_m: float = Field(description="smallest distance from the hull to any obstacle")
    coverage: float | None = Field(default=None, description="covered part of the area, if there is one")


NO_FLIGHT = QoF(
    success=False,
    flight_time_s=0.0,
    distance_m=0.0,
    energy_kj=0.0,
    state_of_charge=1.0,
    missions_per_charge=0.0,
    replans=0,
    min_clearance_m=0.0,
)
"""Of a mission that died before its first report."""


STRIKES_KEPT = 100
"""Of a fault that recurs: so many of its strikes are in its record, all are counted."""


class RepeatedInjection(Strict):
    """One strike of a fault that recurs; values as in :class:`InjectionRecord`."""

    invocation: int
    virtual_time_ns: int
    state: list[str] = []
    point: int = 0
    module: str = ""
    build_id: str = ""
    offset: int = 0
    symbol: str = ""
    instruction: str = ""
    operand: Literal["source", "destination", ""] = ""
    register_name: str = ""
    address: int = 0
    bits: list[int]
    before: str
    after: str
    read_back: str


class InjectionRecord(Strict):
    """One injection in full: where and when it struck, and what it changed.

    Values are those of the ``width_bits`` that were struck, as one number in hexadecimal; the bytes of
    memory and instructions are taken as little-endian. ``bits`` are numbers of bits of that number.
    """

    status: Literal["injected", "not_activated", "not_reached", "diverged", "failed"]
    reason: str = Field(default="", description="why, where the status is not `injected` or only in part")
    precision: Literal["exact", "occurrence", "rehearsed", "cpu_time"] = Field(
        default="cpu_time", description="how exactly the injection point was reached"
    )
    node: str
    kernel: str = Field(description="empty for a source-level fault")
    invocation: int = Field(description="of the kernel, or number of the message; from 0")
    state: list[str] = Field(default=[], description="inter-kernel states struck by a source-level fault")
    point: int = Field(default=0, description="of the trajectory that was struck")
    model: FaultModel = "bitflip"
    scope: Literal["kernel", "thread"] = "thread"
    pid: int = 0
    tid: int = 0
    module: str = ""
    build_id: str = ""
    offset: int = 0
    symbol: str = ""
    line: str = Field(default="", description="FILE:LINE of the source, where debug information tells it")
    instruction_bytes: str = ""
    instruction: str = ""
    operand: Literal["source", "destination", ""] = ""
    register_name: str = Field(default="", alias="register")
    address: int = Field(default=0, description="of the memory that was struck")
    width_bits: int = 0
    element_bits: int = Field(default=0, description="of the floating-point numbers in it; 0 for none")
    bits: list[int] = []
    before: str = Field(default="", description="of a sensor or motor: what it had to say or do, in words")
    after: str = ""
    read_back: str = ""
    points_into: str = Field(default="", description="what `before` points into, if it is a pointer")
    instruction_after: str = Field(default="", description="what was executed in its place")
    held_instructions: int = Field(default=0, description="for how many a bit was held")
    virtual_time_ns: int = 0
    pause_us: float = 0.0
    threads_stopped: int = 0
    trigger: Trigger | None = Field(default=None, description="when it struck, for the same again")
    strikes: int = Field(default=0, description="of a fault that recurs: how often it struck")
    struck: list[RepeatedInjection] = Field(default=[], description=f"of these the first {STRIKES_KEPT}")
    call_end_ns: int = Field(
        default=0, description="virtual time at which the call ends that was struck first"
    )
    probes: int = Field(default=0, description="copies of the node that were run ahead to find the site")
    resampled: int = Field(
        default=0, description="sites passed over: system call, nothing eligible, outside the scope"
    )


def with_strike(so_far: InjectionRecord | None, record: InjectionRecord) -> InjectionRecord:
    """The record of a fault that recurs, after one more ``record``: the first strike's, and the count.

    A record may tell of several strikes at once: those of a call.
    """
    base = record if so_far is None or not so_far.strikes else so_far
    if record.status != "injected":
        return base
    strikes, struck = (0, []) if so_far is None else (so_far.strikes, so_far.struck)
    told = record.struck if record.strikes else [strike_of(record)]
    return base.model_copy(
        update={
            "strikes": strikes + max(record.strikes, 1),
            "struck": [*struck, *told][:STRIKES_KEPT],
            "reason": base.reason or record.reason,
        }
    )


def strike_of(record: InjectionRecord) -> RepeatedInjection:
    """What a fault that recurs keeps of one of its strikes."""
    return RepeatedInjection.model_validate(
        {name: getattr(record, name) for name in RepeatedInjection.model_fields}
    )


def repeatable(record: InjectionRecord) -> InjectionRecord:
    """The part of a record that is the same in every repetition: no pids, no wall times."""
    return record.model_copy(update={"pid": 0, "tid": 0, "pause_us": 0.0, "threads_stopped": 0, "probes": 0})


class KernelUse(Strict):
    """How often a kernel ran in a flight and what it took of its thread, summed, and its squares summed.

    A call that ends after the flight is none of its ``invocations``: no fault is drawn for it.
    """

    invocations: int
    cpu_ns: int
    cpu_squares_ns2: float = 0.0


class NodeReport(Strict):
    """One node's part in a flight. Times are wall clock and no part of what repeats."""

    result: NodeResult
    crashes: int = 0
    hangs: int = 0
    restarts: int = 0
    causes: list[str] = Field(default=[], description="what ended it: a signal, an exception, a hang")
    steps: int = 0
    dropped: int = Field(default=0, description="triggers superseded while the node was busy")
    late: int = Field(default=0, description="ticks that the simulator began more than a tick late")
    malformed: int = Field(default=0, description="messages that it refused because they make no sense")
    outdated: int = Field(default=0, description="messages that it refused because there were newer ones")
    alarms: int = Field(default=0, description="outputs that were found wrong")
    recomputed: int = Field(default=0, description="outputs that were made again")
    ungated: int = Field(default=0, description="outputs without a verdict: the detector had died")
    lost: int = Field(default=0, description="messages of its own that the mission's link lost")
    guards: dict[str, int] = Field(default={}, description="how often each guard acted in it")
    compute_s: float = 0.0
    messaging_s: float = 0.0
    waiting_s: float = 0.0
    kernels: dict[str, KernelUse] = {}


class TopicReport(Strict):
    """Messages of one topic up to the end of the mission, and where they left the golden twin's."""

    messages: int
    digest: str
    diverged_at_s: float | None = None


class RecordingReport(Strict):
    """The size and completeness of a recording."""

    messages: int = Field(description="of the flight; what is drawn for viewers is not counted")
    dropped: int = Field(description="lost because the disk was too slow")
    late: int = Field(default=0, description="injections and alarms that came too late to be in order")
    size_bytes: int
    problem: str = Field(default="", description="why the file is not complete, as the system says")


ProofBy = Literal["same_memory", "same_messages", "same_state", "same_death", "idle_guards"]


class Proof(Strict):
    """Why a flight with a fault need not be flown: what was seen of the struck node, running alone.

    ``same_memory``: after the call its memory was that of an unstruck copy. ``same_messages``: it sent what
    it had sent in the golden twin, to the end. ``same_state``: after the call its memory was that in a flight
    that was flown. ``same_death``: within the call it died as it did in a flight that was flown.
    ``idle_guards``: the fault, in a message, was flown with these guards and others that did nothing.
    """

    by: ProofBy

    @property
    def told(self) -> str:
        """What was seen that proves it, in words."""
        return {
            "same_memory": "after the call, memory as in the golden twin",
            "same_messages": "to the end, messages as in the golden twin",
            "same_state": "after the call, memory as in a flight that was flown",
            "same_death": "in the call, the death of a flight that was flown",
            "idle_guards": "flown with other guards, which did nothing",
        }[self.by]


class Outcome(Strict):
    """The outcome of one mission: its result, quality of flight and reports."""

    spec: MissionSpec
    result: MissionResult
    reason: str = ""
    qof: QoF
    digest: str = Field(description="over every recorded message, in the order of topic and sequence")
    wall_s: float
    nodes: dict[str, NodeReport]
    topics: dict[str, TopicReport]
    injection: InjectionRecord | None = None
    detection: DetectionReport | None = None
    golden: GoldenTwin | None = None
    properties: list[PropertyResult] = Field(default=[], description="in the order of the specification")
    harm: list[HarmEvent] | None = Field(
        default=None, description="beside the golden twin; empty: unharmed, none: a flight without a twin"
    )
    recording: RecordingReport | None = None
    propagation: Propagation | None = Field(default=None, description="of a recorded flight with a fault")
    refused_messages: int = Field(default=0, description="not recorded: no sequence number, or an old one")
    recovered_messages: int = Field(
        default=0, description="late deliveries fetched again from the recorder; differs from run to run"
    )
    fixed_pids: bool = Field(default=False, description="nodes had the pids that they have in every flight")
    proof: Proof | None = Field(default=None, description="of an outcome that was proven, not flown")

    @property
    def acting_guards(self) -> Guards:
        """The guards that acted in any node."""
        return frozenset(name for node in self.nodes.values() for name, times in node.guards.items() if times)


class GoldenTwin(Strict):
    """The flight without the fault, to set beside the faulty one."""

    result: MissionResult
    qof: QoF
    digest: str
    guards: tuple[str, ...] = Field(default=(), description="those that acted in it")
