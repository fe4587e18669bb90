"""Zenoh sessions: who listens where, and how messages are keyed and stamped.

All sessions of a mission meet in one private folder of Unix sockets (mode 0700), so nothing listens
on a network and only the same user can join. The supervisor's session is the router, proxies are peers
that find each other by gossip; multicast scouting is off. Each mission has its own namespace.
"""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import zenoh
from zenoh.handlers import Callback

from services.bus.horizon import Stamped
from services.bus.messages import MalformedMessageError
from services.bus.ros2 import GID_BYTES, Attachment, data_key
from services.bus.topics import TOPICS

DOMAIN_ID = 0
"""Within a mission; the bridge (``deploy/ros2``) has the domain that it is given."""
LEASE_MS = 60_000
"""A proxy that a debugger or a loaded machine holds up is not dead: 10 s, the default, is too short."""


class BusError(Exception):
    """The bus failed: an infrastructure error, never a result of a mission."""


@dataclass(frozen=True, slots=True)
class BusAddress:
    """Where the sessions of one mission meet."""

    folder: Path
    namespace: str

    @property
    def clock(self) -> Path:
        """The page of a flight's clock in real time."""
        return self.folder / "clock"

    def endpoint(self, name: str) -> str:
        """The Unix socket on which session ``name`` listens."""
        return f"unixsock-stream/{self.folder}/{name}.sock"


def open_session(
    address: BusAddress, name: str, *, router: bool = False, more: Mapping[str, object] = MappingProxyType({})
) -> zenoh.Session:
    """Open the session of a proxy, a sidecar or the supervisor (``router``), with ``more`` settings."""
    settings = {
        "mode": "router" if router else "peer",
        "namespace": address.namespace,
        "listen/endpoints": [address.endpoint(name)],
        "connect/endpoints": [] if router else [address.endpoint("router")],
        "connect/exit_on_failure": True,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        # Half a second by default, for routers to be found by multicast; there is none to wait for.
        "scouting/delay": 0,
        "transport/link/tx/lease": LEASE_MS,
        # A killed node must leave no shared-memory segment behind, and our messages are small.
        "transport/shared_memory/enabled": False,
        **more,
    }
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def open_visitor(address: BusAddress) -> zenoh.Session:
    """Open a session that only asks: nodes do not connect to it.

    :raises zenoh.ZError: if nobody meets there.
    """
    config = zenoh.Config()
    for key, value in {
        "mode": "client",
        "namespace": address.namespace,
        "connect/endpoints": [address.endpoint("router")],
        "connect/timeout_ms": 1000,
        "connect/exit_on_failure": True,
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def hand_over(take: Callable[[Any], None]) -> Callback[Any]:
    """A handler for ``take``, called on Zenoh's own thread: it may only put into a queue.

    By default each subscriber has a thread of its own in between, one more wake-up for each message.
    """
    return Callback(take, indirect=False)


def declare_publisher(on: zenoh.Session, key: str, encoding: zenoh.Encoding | None = None) -> zenoh.Publisher:
    """Declare a publisher that loses nothing: where the way is full, as on a loaded machine, it waits.

    Zenoh's own drop a message then, by default and without a word.
    """
    return on.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK, encoding=encoding)


@functools.cache
def topic_key(name: str) -> str:
    """The key of a topic's messages, as rmw_zenoh forms it."""
    return data_key(DOMAIN_ID, name, TOPICS[name].type)


def horizon_key(stage: str) -> str:
    """The key on which a stage publishes its promises."""
    return f"horizon/{stage}"


def gate_key(node: str) -> str:
    """The key on which a node asks the injector for leave at the entry and exit of an armed kernel."""
    return f"gate/{node}"


def verdict_key(stage: str) -> str:
    """The key on which a stage asks the detector (``services/bus/detector_protocol.py``)."""
    return f"verdict/{stage}"


def alarm_key(stage: str) -> str:
    """The key of a stage's alarms, JSON of :class:`services.models.detection.AlarmRecord`."""
    return f"alarm/{stage}"


HISTORY_KEY = "history"
"""Where the recorder answers for messages that did not arrive."""


def publisher_gid(node: str, topic: str) -> bytes:
    """The 16-byte identity of a publisher: the same in every repetition of a flight."""
    return hashlib.blake2b(f"{node}/{topic}".encode(), digest_size=GID_BYTES).digest()


def attach(seq: int, ready_ns: int, gid: bytes, promise: bytes = b"") -> bytes:
    """rmw_zenoh's attachment: sequence number, source timestamp (virtual time), publisher.

    After it there may be its publisher's ``promise``.
    """
    return Attachment(seq, ready_ns, gid).packed() + promise


def stamped(sample: zenoh.Sample) -> tuple[Stamped, bytes]:
    """The message in a Zenoh sample, with its sequence number and stamp, and the promise that it carries.

    That is empty if it carries none.

    :raises MalformedMessageError: if the attachment is missing or not of rmw_zenoh's form.
    """
    attachment = sample.attachment
    raw = attachment.to_bytes() if attachment is not None else b""
    try:
        (seq, ready_ns, _), promise = Attachment.split(raw)
    except ValueError as error:
        message = f"{sample.key_expr}: {error}"
        raise MalformedMessageError(message) from error
    return Stamped(seq, ready_ns, sample.payload.to_bytes()), promise
