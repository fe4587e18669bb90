"""The injector on the bus: a sidecar that knows every node by its announcement and corrupts one."""

from __future__ import annotations

import json
import os
import queue
from collections.abc import Callable
from typing import Any

import zenoh

from injector.session import Call, inject_at_cpu_time
from services.bus import announce, rng, session
from services.bus.announce import Announcement
from services.bus.messages import Injection, encode
from services.bus.mission import FaultSpec
from services.bus.node import NodeSetup
from services.bus.outcome import InjectionRecord
from services.bus.session import Meeting
from services.bus.topics import TOPICS
from services.bus.vitals import Vitals
from services.kernels import KERNELS


def warm_up() -> None:
    """Nothing of the injector is compiled."""


def main(setup: NodeSetup, meeting: Meeting, _: Vitals) -> None:
    """Wait for the armed call, inject once, let everybody pass after that; end with the simulator."""
    fault = setup.spec.fault
    assert fault is not None  # noqa: S101 - the injector is started with a fault only
    with session.open_session(meeting, setup.name) as bus:
        gate = Gate(bus, KERNELS[fault.target].stage)
        publisher = bus.declare_publisher(session.topic_key("injection"))
        token = bus.liveliness().declare_token(announce.announcement(setup.name).key)
        if (entering := gate.next()) is not None:
            record = inject(gate, entering, fault, setup.spec.seed)
            text = record.model_dump_json(by_alias=True)
            publisher.put(encode(Injection(record=text), TOPICS["injection"].type))
            while (passing := gate.next()) is not None:
                gate.open(passing)
        token.undeclare()  # type: ignore[no-untyped-call]


def inject(gate: Gate, entering: zenoh.Query, fault: FaultSpec, seed: int) -> InjectionRecord:
    """Inject into the node that is at the gate, while every node stands."""
    request = json.loads(entering.payload.to_bytes()) if entering.payload is not None else {}
    target = gate.announced[KERNELS[fault.target].stage]
    own = os.getpid()
    others = [one for _, one in sorted(gate.announced.items()) if one.pid not in (target.pid, own)]
    call = Call(target, int(request["virtual_time_ns"]), armed=lambda: gate.open(entering), marked=True)
    return inject_at_cpu_time(call, others, fault, rng.generator(seed, "injection", fault.seed))


class Gate:
    """Where the armed node waits, and who is there. Zenoh's threads only fill the queue."""

    def __init__(self, bus: zenoh.Session, stage: str) -> None:
        self.announced: dict[str, Announcement] = {}
        self._key = session.gate_key(stage)
        self._events: queue.SimpleQueue[tuple[Callable[[Any], bool], Any]] = queue.SimpleQueue()
        self._declared = (
            bus.declare_queryable(
                self._key, session.hand_over(lambda query: self._events.put((_is_query, query)))
            ),
            bus.liveliness().declare_subscriber(
                announce.ALL,
                session.hand_over(lambda sample: self._events.put((self._meet, sample))),
                history=True,
            ),
        )

    def next(self) -> zenoh.Query | None:
        """The next request at the gate; None once the simulator is gone."""
        while True:
            handle, event = self._events.get()
            if handle(event):
                return event if handle is _is_query else None

    def open(self, query: zenoh.Query) -> None:
        """Let the node pass."""
        with query:
            query.reply(self._key, b"")

    def _meet(self, sample: zenoh.Sample) -> bool:
        """Note who came or went; whether the flight is over by that."""
        one = Announcement.parse(str(sample.key_expr))
        if sample.kind == zenoh.SampleKind.PUT:
            self.announced[one.name] = one
            return False
        if self.announced.get(one.name) == one:
            del self.announced[one.name]
        return one.name == "sim"


def _is_query(_: zenoh.Query) -> bool:
    return True
