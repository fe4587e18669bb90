"""The bus as a mission's recorder sees it: messages, promises, the injection and alarms, in one thread."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from typing import Any

import zenoh

from deploy.recording.alarms import Alarms
from deploy.recording.ordering import EVENTS, MessageOrder
from deploy.recording.recorder import FlightRecorder
from services.bus import session
from services.bus.messages import Alarm, Injection, MalformedMessageError, decode, encode
from services.bus.topics import RECORDED, STAGES, TOPICS
from services.models.outcome import InjectionRecord, repeatable, with_strike

GATHER_S = 0.005
"""Wall time for which messages are gathered, so that many are handled in one wake-up: nobody waits for that.
A question, for whose answer a node waits, is handled at once."""


class MissionBus:
    """Takes in all that the nodes of one mission publish, and gives them what they missed.

    Zenoh's threads only queue what arrives; it is handled within :meth:`take_in`. Of a fault that ``recurs``
    the strikes are counted.
    """

    def __init__(
        self, bus: zenoh.Session, recorder: FlightRecorder, order: MessageOrder, *, recurs: bool = False
    ) -> None:
        self.recorder = recorder
        self.alarms = Alarms()
        self._injections: list[InjectionRecord] = []
        self.last_message_s = time.monotonic()
        self._order = order
        self._recurs = recurs
        self._events: queue.SimpleQueue[tuple[Callable[[Any], None], Any]] = queue.SimpleQueue()
        self._asked = threading.Event()
        self._declared: list[Any] = []
        for topic in RECORDED:
            self._subscribe(bus, session.topic_key(topic.name), self._recording(topic.name))
        for stage in STAGES:
            self._subscribe(bus, session.horizon_key(stage), self._following(stage))
        self._subscribe(bus, session.topic_key("injection"), self._take_injection)
        self._answer(bus, f"{session.HISTORY_KEY}/**", self._replay_history)
        self._answer(bus, session.alarm_key("*"), self._take_alarm)
        self._horizons = {
            stage: session.declare_publisher(bus, session.horizon_key(stage)) for stage in STAGES
        }

    def take_in(self, timeout_s: float) -> bool:
        """Handle what has arrived; wait for it up to ``timeout_s``. False if nothing came."""
        try:
            handle, arrived = self._events.get(timeout=timeout_s)
        except queue.Empty:
            return False
        self._asked.wait(GATHER_S)
        self._asked.clear()
        handle(arrived)
        while not self._events.empty():
            handle, arrived = self._events.get()
            handle(arrived)
        return True

    def injection(self, until_ns: int) -> InjectionRecord | None:
        """The record of the mission's fault: of one that recurs, with all strikes up to that virtual time.

        Calls that end later do not count: how far they come is chance.
        """
        if not self._recurs:
            return self._injections[-1] if self._injections else None
        found: InjectionRecord | None = None
        for record in self._injections:
            if max(record.virtual_time_ns, record.call_end_ns) <= until_ns:
                found = with_strike(found, record)
        return found

    def promise(self, stage: str, payload: bytes) -> None:
        """Publish and record a promise on behalf of a stage that is dead."""
        self.recorder.hear(stage, payload)
        self._horizons[stage].put(payload)

    def _subscribe(self, bus: zenoh.Session, key: str, handle: Callable[[Any], None]) -> None:
        queued = session.hand_over(lambda sample: self._events.put((handle, sample)))
        self._declared.append(bus.declare_subscriber(key, queued))

    def _answer(self, bus: zenoh.Session, key: str, handle: Callable[[Any], None]) -> None:
        def queue_question(query: zenoh.Query) -> None:
            self._events.put((handle, query))
            self._asked.set()

        self._declared.append(bus.declare_queryable(key, session.hand_over(queue_question)))

    def _recording(self, topic: str) -> Callable[[Any], None]:
        def handle(sample: zenoh.Sample) -> None:
            self.last_message_s = time.monotonic()
            try:
                message, promise = session.stamped(sample)
                self.recorder.record(topic, message)
                if promise:
                    self.recorder.hear(TOPICS[topic].publisher, promise)
            except MalformedMessageError:
                self.recorder.malformed += 1

        return handle

    def _following(self, stage: str) -> Callable[[Any], None]:
        def handle(sample: zenoh.Sample) -> None:
            self.last_message_s = time.monotonic()
            self.recorder.hear(stage, sample.payload.to_bytes())

        return handle

    def _take_injection(self, sample: zenoh.Sample) -> None:
        message = decode(sample.payload.to_bytes(), TOPICS["injection"].type)
        record = InjectionRecord.model_validate_json(message.record)
        self._injections.append(record)
        event = Injection(record=repeatable(record).model_dump_json(by_alias=True))
        self._order.tell("injection", record.virtual_time_ns, encode(event, TOPICS["injection"].type))

    def _take_alarm(self, query: zenoh.Query) -> None:
        alarm = self.alarms.take(query)
        if alarm is not None:
            event = Alarm(record=alarm.model_dump_json())
            self._order.tell("alarm", alarm.virtual_time_ns, encode(event, EVENTS["alarm"]))

    def _replay_history(self, query: zenoh.Query) -> None:
        """Give a node the messages, or the promise of a stage, that it missed."""
        with query:
            key = str(query.key_expr)
            topic = key.removeprefix(f"{session.HISTORY_KEY}/")
            if topic.startswith("horizon/"):
                promise = self.recorder.horizon(topic.removeprefix("horizon/"))
                if promise is not None:
                    query.reply(key, promise)
                return
            first = int(query.payload.to_bytes()) if query.payload is not None else 0
            for message in self.recorder.since(topic, first):
                gid = session.publisher_gid(TOPICS[topic].publisher, topic)
                query.reply(
                    key, message.payload, attachment=session.attach(message.seq, message.ready_ns, gid)
                )
