"""The detector of a mission: its specification, its alarms and its report."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from services.models.base import Strict

DETECTOR = "detector"
"""The process, and among the latencies that of one check."""

Scope = Literal["all", "planning_control", "perception", "planning", "control", "off"]
"""The stages that recover: one of them, planning and control, all three (the paper, section V-E), or none."""


Fallback = Literal["as_made", "last_good", "stop", "trail", "simple"]
"""What is published in the place of an output that is still alarmed after the last retry.

``as_made``: the output itself. ``last_good``: the last output that was accepted. ``stop``: what has the
vehicle stop. ``trail``: a trajectory back along the way that it came. ``simple``: the command of a controller
that is simple enough to be trusted (run-time assurance, ASTM F3269).
"""


class DetectorSpec(Strict):
    """The specification of one detector in a mission.

    With the ``gate`` on, an output is held until its verdict; off, it is published at once and its alarm is
    recorded. A stage in the scope of ``recovery`` makes an alarmed output again, at most ``retries`` times,
    and then publishes what the :data:`Fallback` in its name says.
    ``model`` is the content of a model file; where a specification is written, the file's name stands for it.
    """

    scheme: str = Field(description="entry point of `zenfi.detectors`")
    model: dict[str, Any] | None = Field(default=None, description="default: the one that comes along")
    gate: Literal["on", "off"] = "on"
    recovery: Scope = "all"
    retries: int = Field(default=1, ge=0, le=10, description="of one output")
    perception: Literal["as_made", "last_good", "stop"] = "as_made"
    planning: Literal["as_made", "last_good", "stop", "trail"] = "as_made"
    control: Literal["as_made", "last_good", "stop", "simple"] = "as_made"
    check_us: float | None = Field(
        default=None, ge=0, le=1e6, description="virtual time of a check; default: the platform's"
    )


Action = Literal["recomputed", "waypoint_dropped", "published", "last_good", "stop", "trail", "simple"]
"""What was done about an alarm."""


class AlarmRecord(Strict):
    """One alarm, and what the stage did about it.

    ``recomputed``: the output was made again before it was published, at control with the next waypoint.
    ``waypoint_dropped``: it had been published, and control went on to the next waypoint. ``published``:
    nothing, as the gate is off, the stage recovers not, or it was the last of the retries. Another word: what
    was published in its place (:data:`Fallback`).
    """

    stage: str
    topic: str
    state: str = Field(description="the one that is farthest from the normal; empty: it made no sense")
    row: int
    score: float = Field(description="above 1; in units of what is allowed")
    virtual_time_ns: int
    action: Action
    cost_ns: int = Field(default=0, description="virtual time of the recomputation")
    true: bool = Field(default=False, description="whether a fault had struck that stage or one before it")


class RecoveryReport(Strict):
    """What was tried after alarms of a fault, what it cost, whether the flight came nearer its golden twin.

    An offset is the distance in m from the twin's whole path: ``offset_m`` at the first of the actions,
    ``end_offset_m`` at the mission's end.
    """

    actions: dict[Action, int] = Field(description="how often each was taken after a true alarm")
    cost_ns: int = Field(description="virtual time of what was made again")
    offset_m: float
    end_offset_m: float

    @property
    def came_nearer(self) -> bool:
        """Whether the flight ended nearer its twin's path than it was when recovery began."""
        return self.end_offset_m < self.offset_m


class DetectionReport(Strict):
    """What a detector did up to the mission's end. Times are virtual and parts of the mission's time."""

    alarms: list[AlarmRecord] = Field(description="in the order of time and stage")
    checks: int
    detection_share: float
    recomputation_share: float
    ungated: int = Field(description="outputs without a verdict: the detector had died")
    recovery: RecoveryReport | None = Field(
        default=None, description="beside the golden twin; none: nothing was done after a true alarm"
    )
