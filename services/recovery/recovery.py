"""Recovery of a stage: its output is held until a detector accepts it, and made again if it does not."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any, Literal, Protocol, TypeVar

from services.bus.arrays import Floats
from services.bus.detector_protocol import DetectorReply, answered, question
from services.bus.messages import encode
from services.bus.topics import TOPICS
from services.models.detection import Action, AlarmRecord, DetectorSpec, Fallback
from services.recovery.reexecution import SCHEME, Reexecution, RepeatableStage

SCOPES = {
    "all": ("perception", "planning", "control"),
    "planning_control": ("planning", "control"),
    "off": (),
}
"""The stages that a scope of recovery names; each other scope is a stage."""

Again = Callable[[], object]
Made = TypeVar("Made")

NO_FALLBACKS: Mapping[Fallback, Any] = MappingProxyType({})
"""Of a stage that publishes its outputs whatever is said of them."""


class RecoveringStage(RepeatableStage, Protocol):
    """What recovery needs of the node that it belongs to."""

    name: str

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
        self._fallback: Fallback = "as_made"
        if spec is not None and self._recovers:
            self._fallback = {
                "perception": spec.perception,
                "planning": spec.planning,
                "control": spec.control,
            }[stage.name]
        self._accepted: dict[str, Any] = {}
        self._reexecution = Reexecution(stage) if spec is not None and spec.scheme == SCHEME else None

    @property
    def reexecutes(self) -> bool:
        """Whether outputs are made twice: then one that is made again is made as before."""
        return self._reexecution is not None

    def sound(
        self,
        topic: str,
        compute: Callable[[], Made],
        message: Callable[[Made], Any],
        shown: Callable[[Any], Floats],
        before_again: Again | None = None,
        instead: Mapping[Fallback, Callable[[], Made]] = NO_FALLBACKS,
        undo: Again | None = None,
    ) -> tuple[Made, Any]:
        """What ``compute`` makes and the ``message`` of it; made again while that is alarmed.

        ``shown`` gives what a detector is shown of a message. What is alarmed after the last of the retries
        is taken all the same, or what ``instead`` makes for the stage's fallback, which nobody judges:
        before that, ``undo`` takes back what the alarmed output has changed of the stage.
        ``before_again`` comes before each, and, with the gate off, before what follows an alarm.
        """
        make = self._maker(topic, compute, message)
        if topic in self._alarmed_before and before_again is not None:
            before_again()
        self._alarmed_before.discard(topic)
        made, sent = make()
        if self._spec is None:
            return made, sent
        if self._spec.gate == "off":
            self._unjudged[topic] = _Unjudged(shown(sent), before_again)
            return made, sent
        for _ in range(self._retries):
            found = self._gated(topic, shown(sent))
            if found is None:
                self._accepted[topic] = made
                return made, sent
            made, sent = self._made_again(topic, found, make, before_again)
        found = self._gated(topic, shown(sent))
        if found is None:
            self._accepted[topic] = made
            return made, sent
        alarmed_ns = self._stage.now_ns
        action, make_instead = self._fallback_of(topic, instead)
        if make_instead is not None:
            if undo is not None:
                undo()
            made = make_instead()
            sent = message(made)
        self._tell(topic, found, action, alarmed_ns)
        self._fresh = True
        return made, sent

    def decided(self, topic: str, decide: Callable[[], Made], told: Callable[[Made], bytes]) -> Made:
        """What a stage decides before its output ``topic`` and keeps for later ones, the goal to fly to.

        Nothing of it is published, so only re-execution judges it: it is made again while two runs of it
        differ. ``told`` is all of it as bytes; ``decide`` changes nothing of the stage.
        """
        twice = self._reexecution
        if twice is None or self._spec is None:
            return decide()
        made = twice.make(decide, told)
        gated = self._spec.gate == "on"
        for _ in range(self._retries if gated else 0):
            self._pass_second_run()
            found = self._differing(topic)
            if found is None:
                return made
            made = self._made_again(topic, found, lambda: twice.make(decide, told), None)
        if gated:
            self._pass_second_run()
        found = self._differing(topic)
        if found is not None:
            self._tell(topic, found, "published", self._stage.now_ns)
        return made

    @property
    def _retries(self) -> int:
        """How often an alarmed output is made again."""
        return self._spec.retries if self._spec is not None and self._recovers else 0

    def _made_again(
        self, topic: str, found: DetectorReply, make: Callable[[], Made], before_again: Again | None
    ) -> Made:
        """What is made in the place of what was alarmed; counted and told."""
        alarmed_ns = self._stage.now_ns
        if before_again is not None:
            before_again()
            self._fresh = True
        made = make()
        self._stage.count("recomputed")
        self._tell(topic, found, "recomputed", alarmed_ns)
        return made

    def _fallback_of(
        self, topic: str, instead: Mapping[Fallback, Callable[[], Made]]
    ) -> tuple[Action, Callable[[], Made] | None]:
        """How what is published in the place of an alarmed output is made; None: it is published itself."""
        if self._fallback == "last_good" and topic in self._accepted:
            return self._fallback, partial(self._accepted.__getitem__, topic)
        if self._fallback != "as_made" and self._fallback in instead:
            return self._fallback, instead[self._fallback]
        return "published", None

    def _maker(
        self, topic: str, compute: Callable[[], Made], message: Callable[[Made], Any]
    ) -> Callable[[], tuple[Made, Any]]:
        """How an output and its message are made, once or twice."""

        def make() -> tuple[Made, Any]:
            made = compute()
            sent = message(made)
            self._stage.corrupt(topic, sent)
            return made, sent

        twice = self._reexecution
        if twice is None:
            return make
        return lambda: twice.make(make, lambda both: encode(both[1], TOPICS[topic].type))

    def published(self, topic: str) -> None:
        """With the gate off, take the verdict on what has just been published."""
        judged = self._unjudged.pop(topic, None)
        found = self._asked(topic, judged.rows) if judged is not None else None
        if judged is None or found is None:
            return
        drops = self._recovers and judged.before_again is not None and not self.reexecutes
        if drops:
            self._alarmed_before.add(topic)
        self._tell(topic, found, "waypoint_dropped" if drops else "published", self._stage.now_ns)
        self._fresh = True

    def _gated(self, topic: str, rows: Floats) -> DetectorReply | None:
        found = self._asked(topic, rows)
        self._stage.elapse_check(self._checks)
        self._pass_second_run()
        self._checks += 1
        return found

    def _pass_second_run(self) -> None:
        """Have the virtual time of a second run pass, if there was one."""
        if self._reexecution is not None:
            self._stage.now_ns += self._reexecution.took_ns

    def _asked(self, topic: str, rows: Floats) -> DetectorReply | None:
        if self._reexecution is not None:
            return self._differing(topic)
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

    def _differing(self, topic: str) -> DetectorReply | None:
        """What is said of an output that two runs made: nothing if they made the same."""
        assert self._reexecution is not None  # noqa: S101 - asked for where there is one
        if not self._reexecution.differed:
            return None
        self._stage.count("alarms")
        return DetectorReply(topic, 0, sys.float_info.max)

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
