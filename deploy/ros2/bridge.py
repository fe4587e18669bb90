"""A flight in a ROS 2 domain: what its stages publish is published again there, as it was.

So are the standard messages that are made from it (:mod:`deploy.recording.derived`), by a node of their own.

The bridge looks into the recorder from a thread of its own. Nothing of the flight waits for it or depends on
it, so a flight that is shown is the same as one that is not.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

from rosbags.typesys.stores.ros2_jazzy import rosgraph_msgs__msg__Clock as Clock

from deploy.recording.derived import DERIVED, DerivedMessages
from deploy.recording.ordering import SentMessage
from deploy.recording.recorder import FlightRecorder
from deploy.ros2.domain import Domain
from services.bus.horizon import Stamped
from services.bus.messages import encode, header
from services.bus.ros2 import Qos, quality
from services.bus.topics import RECORDED
from services.models.mission import MissionSpec

LOOK_S = 0.005
CLOCK, CLOCK_TYPE = "clock", "rosgraph_msgs/msg/Clock"
DERIVED_BY = "derived"
"""The node that publishes what is made from the flight's messages."""

_BY = "odometry"
"""The topic whose messages, one a tick, set the clock."""


def clock(now_ns: int) -> bytes:
    """The message that says what time it is, for nodes with ``use_sim_time``."""
    return encode(Clock(clock=header(now_ns, "").stamp), CLOCK_TYPE)


class Bridge:
    """Shows one flight in a domain, ``pace`` times as fast as real time; 0: as fast as it is flown.

    Source timestamps, and what ``/clock`` says, are virtual time.
    """

    def __init__(self, domain: Domain, pace: float) -> None:
        self._pace = pace
        self._publishers = {
            topic.name: domain.publisher(topic.publisher, f"/{topic.name}", topic.type, quality(topic))
            for topic in RECORDED
        }
        self._derived = {
            name: domain.publisher(DERIVED_BY, f"/{name}", topic.type, topic.quality)
            for name, topic in DERIVED.items()
        }
        self._clock = domain.publisher("sim", f"/{CLOCK}", CLOCK_TYPE, Qos(depth=1))
        self._shown = dict.fromkeys(self._publishers, 0)
        self._landed = threading.Event()
        self._thread: threading.Thread | None = None
        self._error: BaseException | None = None

    def show(self, spec: MissionSpec, recorder: FlightRecorder) -> None:
        """Begin to show the flight of ``spec``; called at its start."""
        seen = (recorder, DerivedMessages(spec))
        self._thread = threading.Thread(target=self._run, args=seen, daemon=True)
        self._thread.start()

    def finish(self) -> None:
        """Mark the end of the flight and wait until all of it has been shown.

        :raises BaseException: the error by which the bridge failed, if it did.
        """
        self._landed.set()
        if self._thread is not None:
            self._thread.join()
        if self._error is not None:
            raise self._error

    def _run(self, recorder: FlightRecorder, derived: DerivedMessages) -> None:
        try:
            self._show_all(recorder, derived)
        except BaseException as error:  # noqa: BLE001 - raised again where it is waited for
            self._error = error

    def _show_all(self, recorder: FlightRecorder, derived: DerivedMessages) -> None:
        begun = time.monotonic()
        while True:
            landed = self._landed.is_set()  # before the last look, so that nothing is left
            for topic, message in sorted(self._news(recorder), key=lambda one: one[1].ready_ns):
                if self._pace:
                    time.sleep(max(0.0, begun + message.ready_ns / 1e9 / self._pace - time.monotonic()))
                self._publish(topic, message)
                for made in derived.of(SentMessage(topic, message)):
                    self._derived[made.topic].put(made.message.payload, message.ready_ns)
            if landed:
                return
            time.sleep(LOOK_S)

    def _news(self, recorder: FlightRecorder) -> Iterator[tuple[str, Stamped]]:
        for topic, shown in self._shown.items():
            for message in recorder.since(topic, shown):
                self._shown[topic] += 1
                yield topic, message

    def _publish(self, topic: str, message: Stamped) -> None:
        if topic == _BY:
            self._clock.put(clock(message.ready_ns), message.ready_ns)
        self._publishers[topic].put(message.payload, message.ready_ns)
