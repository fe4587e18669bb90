"""Recovery of a stage: its output is held until a detector accepts it, and made again if it does not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol, TypeVar

from services.bus.arrays import Floats
from services.bus.detector_protocol import DetectorReply, answered, question
from services.models.detection import AlarmRecord, DetectorSpec

SCOPES = {
    "all": ("perception", "planning", "control"),
    "planning_control": ("planning", "control"),
    "off": (),
}
"""The stages that a scope of recovery names; each other scope is a stage."""

Action = Literal["recomputed", "waypoint_dropped", "published"]
Again = Callable[[], object]
Made = TypeVar("Made")


class RecoveringStage(Protocol):
    """What recovery needs of the node that it belongs to."""

    name: str
    now_ns: int

    def verdict(self, payload: bytes) -> bytes | None:
        """Ask the detector; None if nobody answers."""
        ...

    def elapse_check(self, number: int) -> None:
        """Advance the time by the latency of a check."""
        ...

    def corrupt(self, topic: str, message: Any) -> None:
        """Let a source-level fault strike a message that is about to be published."""
        ...

    def count(self, what: Literal["alarms", "recomputed", "ungated"]) -> None:
        """Count an alarm, an output made again, or one without a verdict."""
        ...

    def tell_alarm(self, record: AlarmRecord) -> None:
        """Send an alarm to the recorder."""
        ...


@dataclass(frozen=True, slots=True)
class _Unjudged:
    """With the gate off: what the detector is still to be shown, and what an alarm sets off."""

    rows: Floats
    before_again: Again | None


class Recovery:
    """One stage's way to make an output again: bounded, counted, and timed by the kernels that run again.

    Once the detector did not answer it is dead, and outputs go out without a verdict. The time of a check
    passes all the same, so that a flight does not depend on when exactly the detector died.
    """

    def __init__(self, stage: RecoveringStage, spec: DetectorSpec | None) -> None:
        self._stage = stage
        self._spec = spec
        self._recovers = spec is not None and stage.name in SCOPES.get(spec.recovery, (spec.recovery,))
        self._checks = 0
        self._fresh = True
        self._dead = False
        self._unjudged: dict[str, _Unjudged] = {}
        self._alarmed_before: set[str] = set()

    def sound(
        self,
        topic: str,
        compute: Callable[[], Made],
        message: Callable[[Made], Any],
        shown: Callable[[Any], Floats],
        before_again: Again | None = None,
    ) -> tuple[Made, Any]:
        """What ``compute`` makes and the ``message`` of it; made again while that is alarmed.

        ``shown`` gives what a detector is shown of a message. The last of the retries is taken whatever is
        said of it. ``before_again`` comes before each, and, with the gate off, before what follows an alarm.
        """

        def make() -> tuple[Made, Any]:
            made = compute()
            sent = message(made)
            self._stage.corrupt(topic, sent)
            return made, sent

        if topic in self._alarmed_before and before_again is not None:
            before_again()
        self._alarmed_before.discard(topic)
        made, sent = make()
        if self._spec is None:
            return made, sent
        if self._spec.gate == "off":
            self._unjudged[topic] = _Unjudged(shown(sent), before_again)
            return made, sent
        for _ in range(self._spec.retries if self._recovers else 0):
            found = self._gated(shown(sent))
            if found is None:
                return made, sent
            alarmed_ns = self._stage.now_ns
            if before_again is not None:
                before_again()
                self._fresh = True
            made, sent = make()
            self._stage.count("recomputed")
            self._tell(topic, found, "recomputed", alarmed_ns)
        found = self._gated(shown(sent))
        if found is not None:
            self._tell(topic, found, "published", self._stage.now_ns)
            self._fresh = True
        return made, sent

    def published(self, topic: str) -> None:
        """With the gate off, take the verdict on what has just been published."""
        judged = self._unjudged.pop(topic, None)
        found = self._asked(judged.rows) if judged is not None else None
        if judged is None or found is None:
            return
        drops = self._recovers and judged.before_again is not None
        if drops:
            self._alarmed_before.add(topic)
        self._tell(topic, found, "waypoint_dropped" if drops else "published", self._stage.now_ns)
        self._fresh = True

    def _gated(self, rows: Floats) -> DetectorReply | None:
        found = self._asked(rows)
        self._stage.elapse_check(self._checks)
        self._checks += 1
        return found

    def _asked(self, rows: Floats) -> DetectorReply | None:
        reply = None if self._dead else self._stage.verdict(question(rows, fresh=self._fresh))
        self._fresh = False
        if reply is None:
            self._dead = True
            self._stage.count("ungated")
            return None
        found = answered(reply)
        if found is not None:
            self._stage.count("alarms")
        return found

    def _tell(self, topic: str, found: DetectorReply, action: Action, alarmed_ns: int) -> None:
        self._stage.tell_alarm(
            AlarmRecord(
                stage=self._stage.name,
                topic=topic,
                **found._asdict(),
                virtual_time_ns=alarmed_ns,
                action=action,
                cost_ns=self._stage.now_ns - alarmed_ns,
            )
        )
