"""What became of a mission: the one definition of its outcome."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from services.bus.mission import MissionSpec, Trigger
from services.bus.model import Strict

MissionResult = Literal["success", "collision", "no_path", "timeout", "stack_failure"]
NodeResult = Literal["golden", "benign", "sdc", "crash", "hang"]


class QoF(Strict):
    """Quality of flight."""

    success: bool
    flight_time_s: float
    distance_m: float
    energy_kj: float
    state_of_charge: float = Field(description="of the battery at the end, a part of one")
    missions_per_charge: float = Field(description="such flights that a full battery holds; 0 if it failed")
    replans: int
    min_clearance_m: float = Field(description="smallest distance from the hull to any obstacle")


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


class InjectionRecord(Strict):
    """One injection, in full. Register values are hexadecimal, least significant bit last."""

    status: Literal["injected", "not_activated", "not_reached", "diverged", "failed"]
    reason: str = Field(default="", description="why, where the status is not `injected`")
    mode: Literal["exact", "occurrence", "cpu_time"] = "cpu_time"
    node: str
    kernel: str
    invocation: int
    pid: int = 0
    tid: int = 0
    module: str = ""
    build_id: str = ""
    offset: int = 0
    symbol: str = ""
    instruction_bytes: str = ""
    instruction: str = ""
    operand: Literal["source", "destination", ""] = ""
    register_name: str = Field(default="", alias="register")
    width_bits: int = 0
    bits: list[int] = []
    holds_address: bool = Field(default=False, description="whether the register's value lies in memory")
    before: str = ""
    after: str = ""
    read_back: str = ""
    virtual_time_ns: int = 0
    pause_us: float = 0.0
    threads_stopped: int = 0
    trigger: Trigger | None = Field(default=None, description="when it struck, for the same again")
    scouts: int = Field(default=0, description="copies of the node that were run ahead to find the site")
    resampled: int = Field(default=0, description="candidate sites passed over: system call, no register")


class KernelUse(Strict):
    """How often a kernel ran in a flight and what it took of its thread, summed, and its squares summed."""

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
    compute_s: float = 0.0
    messaging_s: float = 0.0
    waiting_s: float = 0.0
    kernels: dict[str, KernelUse] = {}


class TopicReport(Strict):
    """Messages of one topic up to the end of the mission, and where they left the golden twin's."""

    messages: int
    digest: str
    diverged_at_s: float | None = None


class Outcome(Strict):
    """The result of one mission."""

    spec: MissionSpec
    result: MissionResult
    reason: str = ""
    qof: QoF
    digest: str = Field(description="over every recorded message, in the order of topic and sequence")
    wall_s: float
    nodes: dict[str, NodeReport]
    topics: dict[str, TopicReport]
    injection: InjectionRecord | None = None
    golden: GoldenTwin | None = None
    recovered_messages: int = Field(default=0, description="late deliveries fetched again from the recorder")


class GoldenTwin(Strict):
    """The flight without the fault, to set beside the faulty one."""

    result: MissionResult
    qof: QoF
    digest: str
