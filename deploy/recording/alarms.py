"""The alarms of a flight, as its stages report them, and the cost of detection."""

from __future__ import annotations

from collections.abc import Mapping

import zenoh

from deploy.config.platform import check_latency
from deploy.recording.recorder import FlightTrace
from services.bus.topics import STAGES
from services.models.detection import AlarmRecord, DetectionReport
from services.models.mission import MissionSpec
from services.models.outcome import InjectionRecord, NodeReport

JUDGED = ("collision_check", "trajectory", "command")
"""The topics of which each message is held for a verdict."""


class Alarms:
    """Takes in the alarms of one flight."""

    def __init__(self) -> None:
        self._records: list[AlarmRecord] = []

    def take(self, query: zenoh.Query) -> AlarmRecord | None:
        """Take in one alarm; None if the stage sent none."""
        with query:
            if query.payload is None:
                return None
            self._records.append(AlarmRecord.model_validate_json(query.payload.to_bytes()))
            query.reply(str(query.key_expr), b"")
            return self._records[-1]

    def report(
        self,
        spec: MissionSpec,
        trace: FlightTrace,
        end_ns: int,
        injection: InjectionRecord | None,
        nodes: Mapping[str, NodeReport],
    ) -> DetectionReport | None:
        """The report on the detector; None if none was asked for. ``trace`` is that up to ``end_ns``."""
        if spec.detector is None:
            return None
        alarms = sorted(
            (
                record.model_copy(update={"true": _struck_before(record, injection)})
                for record in self._records
                if record.virtual_time_ns <= end_ns
            ),
            key=lambda record: (record.virtual_time_ns, STAGES.index(record.stage)),
        )
        again = [record for record in alarms if record.action == "recomputed"]
        checks = sum(len(trace.times_ns[topic]) for topic in JUDGED) + len(again)
        check_ns = check_latency(spec.platform, spec.detector).mean_ms * 1e6
        whole_ns = max(end_ns, 1)
        return DetectionReport(
            alarms=alarms,
            checks=checks,
            detection_share=checks * check_ns / whole_ns,
            recomputation_share=sum(record.cost_ns for record in again) / whole_ns,
            ungated=sum(report.ungated for report in nodes.values()),
        )


def _struck_before(alarm: AlarmRecord, injection: InjectionRecord | None) -> bool:
    if injection is None or injection.status != "injected":
        return False
    upstream = STAGES.index(injection.node) <= STAGES.index(alarm.stage)
    return upstream and injection.virtual_time_ns <= alarm.virtual_time_ns
