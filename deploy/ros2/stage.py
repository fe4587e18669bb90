"""A ROS 2 node in a stage's place: what the stage may see goes to its domain, its answer comes from there.

A program as docs/own_stack.md has it, on standard input and output. Step by step it publishes what has become
visible, then waits until the node has published one message on each awaited topic.
"""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Iterator
from typing import BinaryIO

import zenoh

from deploy.ros2.bridge import CLOCK, CLOCK_TYPE, clock
from deploy.ros2.domain import Domain, Publisher
from services.bus.ros2 import Qos, quality
from services.bus.topics import TOPICS, published_by
from services.foreign.program import ProgramOutput
from services.models.mission import MissionSpec
from services.models.own_stack import trigger


class Relay:
    """Relays messages between a stage's pipes and the ROS 2 domain."""

    def __init__(self, domain: Domain, awaited: tuple[str, ...], patience_s: float) -> None:
        """``awaited`` are topics of the stage; ``patience_s`` is wall time for the node to appear."""
        self._domain = domain
        self._awaited = awaited
        self._patience_s = patience_s
        self._clock = domain.publisher("sim", f"/{CLOCK}", CLOCK_TYPE, Qos(depth=1))
        self._publishers: dict[str, Publisher] = {}
        self._came: queue.SimpleQueue[ProgramOutput] = queue.SimpleQueue()

    def serve(self, hear: BinaryIO, say: BinaryIO) -> None:
        """Relay messages until standard input ends."""

        def tell(words: bytes) -> None:
            say.write(words)
            say.flush()

        messages: list[tuple[str, int, bytes]] = []
        for words, body in heard(hear):
            if words[0] == "zenfi":
                self._take_place(words[2], MissionSpec.model_validate_json(body))
                tell(b"ready\n")
            elif words[0] == "message":
                messages.append((words[1], int(words[3]), body))
            else:
                for made in self._step(messages, int(words[1])):
                    tell(b"put %s %d\n%b" % (made.topic.encode(), len(made.payload), made.payload))
                messages.clear()
                tell(b"done\n")

    def _take_place(self, stage: str, mission: MissionSpec) -> None:
        own = mission.own_stage(stage)
        assert own is not None  # noqa: S101 - that is why we run
        outputs = published_by(stage)
        if not set(self._awaited) <= {topic.name for topic in outputs}:
            message = f"{stage} does not publish {', '.join(self._awaited)}"
            raise NobodyError(message)
        self._awaited = self._awaited or (outputs[-1].name,)
        for topic in outputs:
            take = self._handler(topic.name)
            self._domain.subscribe(stage, f"/{topic.name}", topic.type, quality(topic), take)
        for name in (trigger(stage), *own.inputs):
            topic = TOPICS[name]
            self._publishers[name] = self._domain.publisher(
                topic.publisher, f"/{name}", topic.type, quality(topic)
            )
        self._await_node(stage)

    def _await_node(self, stage: str) -> None:
        """Wait for a node that publishes the awaited topics and subscribes to the trigger.

        :raises NobodyError: if nobody does.
        """
        deadline = time.monotonic() + self._patience_s
        while missing := [name for name in self._awaited if not self._domain.has("MP", f"/{name}")]:
            self._rest(deadline, f"publishes {', '.join(missing)}")
        going = trigger(stage)
        while not (self._domain.has("MS", f"/{going}") and self._publishers[going].is_linked):
            self._rest(deadline, f"subscribes to {going}")

    def _rest(self, deadline: float, what: str) -> None:
        if time.monotonic() > deadline:
            message = f"nobody in the domain {what}"
            raise NobodyError(message)
        time.sleep(0.05)

    def _handler(self, topic: str) -> Callable[[zenoh.Sample], None]:
        return lambda sample: self._came.put(ProgramOutput(topic, sample.payload.to_bytes()))

    def _step(self, messages: list[tuple[str, int, bytes]], now_ns: int) -> list[ProgramOutput]:
        self._clock.put(clock(now_ns), now_ns)
        for name, ready_ns, payload in messages:
            self._publishers[name].put(payload, ready_ns)
        made: list[ProgramOutput] = []
        while not set(self._awaited) <= {one.topic for one in made}:
            made.append(self._came.get())
        order = [topic.name for topic in published_by(TOPICS[self._awaited[0]].publisher)]
        return sorted(made, key=lambda one: order.index(one.topic))


class NobodyError(Exception):
    """No ROS 2 node is there that could take the stage's place."""


def heard(end: BinaryIO) -> Iterator[tuple[list[str], bytes]]:
    """Parse a program's input: the words of each line, and the body that follows it."""
    while line := end.readline():
        words = line.decode().split()
        yield words, end.read(int(words[-1])) if words[0] in ("zenfi", "message") else b""
