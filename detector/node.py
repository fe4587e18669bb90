"""The detector on the bus: answers each stage's request about what it is going to publish.

Its memory is kept stage by stage, so the order in which different stages' questions arrive changes no answer.
"""

from __future__ import annotations

import queue
import time
from collections.abc import Iterator
from math import inf
from typing import Any

import numpy as np
import zenoh

from detector.schemes.base import Scheme
from detector.schemes.registry import in_flight, rehearse, warm_up
from detector.series.monitored_states import WATCHED, as_check
from services.bus import announce, session
from services.bus.announce import Announcement
from services.bus.detector_protocol import DetectorReply, answer, asked
from services.bus.session import BusAddress
from services.runtime.setup import NodeSetup
from services.system.shared_stats import SharedStats
from services.system.stopwatch import KernelStopwatch

__all__ = ["main", "warm_up"]


def main(setup: NodeSetup, address: BusAddress, stats: SharedStats) -> None:
    """Load the mission's scheme, judge what is asked, end with the last stage."""
    assert setup.spec.detector is not None  # noqa: S101 - the detector is started where one is asked for
    scheme = in_flight(setup.spec.detector)
    rehearse(scheme)
    with session.open_session(address, setup.name) as bus:
        for query in questions(bus, setup.name):
            with query:
                payload = query.payload.to_bytes() if query.payload is not None else b""
                found = judge(scheme, str(query.key_expr).rpartition("/")[2], payload, stats.page)
                query.reply(str(query.key_expr), answer(found))


def judge(scheme: Scheme, stage: str, payload: bytes, page: np.void) -> DetectorReply | None:
    """The scheme's verdict on a request, timed; a malformed request is an alarm."""
    try:
        numbers, fresh = asked(payload)
        values = as_check(stage, numbers)
    except ValueError:
        page["malformed"] += 1
        return DetectorReply("", 0, inf)
    if fresh:
        scheme.reset(stage)
    page["computing"] = 1
    cpu = KernelStopwatch(page, time.CLOCK_THREAD_CPUTIME_ID)
    cpu.restart()
    alarm = scheme.check(stage, values)
    cpu.lap(0)
    page["computing"] = 0
    page["steps"] += 1
    page["invocations"][0] += 1
    return None if alarm is None else DetectorReply(alarm.state, alarm.row, alarm.score)


def questions(bus: zenoh.Session, name: str) -> Iterator[zenoh.Query]:
    """Announce the node and yield each request until simulator and stages have come and gone.

    The stages end after the simulator: the last of them is not to go without a verdict.
    """
    events: queue.SimpleQueue[Any] = queue.SimpleQueue()
    key = session.verdict_key("*")
    declared = (
        bus.declare_queryable(key, session.hand_over(events.put)),
        bus.liveliness().declare_subscriber(announce.ALL, session.hand_over(events.put), history=True),
        bus.liveliness().declare_token(announce.announcement(name).key),
    )
    asking = {*WATCHED, "sim"}
    present: set[Announcement] = set()
    begun = False
    while declared and not (begun and not present):
        event = events.get()
        if isinstance(event, zenoh.Query):
            yield event
            continue
        one = Announcement.parse(str(event.key_expr))
        if one.name in asking:
            (present.add if event.kind == zenoh.SampleKind.PUT else present.discard)(one)
            begun |= one.name == "sim"
