"""A ROS 2 domain over Zenoh: nodes, publishers and subscriptions as rmw_zenoh has them."""

from __future__ import annotations

import json
from collections.abc import Callable
from types import TracebackType
from typing import Any, Literal, Self

import xxhash
import zenoh
import zenoh.ext
from pydantic import Field, ValidationError

from deploy.compose.stack_file import Bus
from deploy.errors import BadSpecError
from services.bus.ros2 import ADMIN_SPACE, GID_BYTES, Attachment, Qos, RosNode, data_key, mangled
from services.bus.session import hand_over
from services.models.base import Strict

ROUTER = "tcp/127.0.0.1:7447"
"""Where rmw_zenoh's router listens."""

HEARTBEAT_S = 0.5
"""After which a subscription detects that it has missed a message: rmw_zenoh's."""


class DomainAddress(Strict):
    """A ROS 2 domain, and the router to which its nodes connect."""

    domain: int = Field(ge=0, le=232)
    endpoint: str = ROUTER


class NoRouterError(BadSpecError):
    """No Zenoh router listens at the endpoint."""


class Publisher:
    """A publisher of a node: numbers and stamps what it sends."""

    def __init__(self, on: zenoh.Session, key: str, token: str, qos: Qos) -> None:
        self._seq = 0
        self._gid = gid(token)
        declare = _declare_latched if qos.transient_local else _declare_stream
        self._publisher = declare(on, key, qos)
        self._token = on.liveliness().declare_token(token)

    def put(self, payload: bytes, source_ns: int) -> None:
        """Publish CDR bytes that were made at a time."""
        self._seq += 1
        self._publisher.put(payload, attachment=Attachment(self._seq, source_ns, self._gid).packed())

    @property
    def is_linked(self) -> bool:
        """Whether a subscriber receives what is put; a latched message waits for one."""
        if not isinstance(self._publisher, zenoh.Publisher):
            return True
        # Its stub says that it were a truth value itself.
        return bool(self._publisher.matching_status.matching)  # type: ignore[attr-defined]


def _declare_stream(on: zenoh.Session, key: str, _: Qos) -> zenoh.Publisher:
    return on.declare_publisher(
        key,
        encoding=zenoh.Encoding.APPLICATION_CDR,
        congestion_control=zenoh.CongestionControl.BLOCK,
    )


def _declare_latched(on: zenoh.Session, key: str, qos: Qos) -> zenoh.ext.AdvancedPublisher:
    """A publisher that keeps its last messages for later subscribers, like rmw_zenoh's transient local."""
    return zenoh.ext.declare_advanced_publisher(
        on,
        key,
        encoding=zenoh.Encoding.APPLICATION_CDR,
        congestion_control=zenoh.CongestionControl.BLOCK,
        cache=zenoh.ext.CacheConfig(max_samples=qos.depth),
        sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S),
        publisher_detection=True,
    )


def gid(token: str) -> bytes:
    """The identity of a publisher: 128 bits of XXH3 of its token, little-endian."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(GID_BYTES, "little")


class Domain:
    """Our session in a domain. Nothing listens: we are a client of the router."""

    def __init__(self, address: DomainAddress) -> None:
        """Open the session as a client of the router.

        :raises BadSpecError: if the endpoint is none that is allowed, or nobody is there.
        """
        try:
            Bus(connect=(address.endpoint,))
        except ValidationError as error:
            raise BadSpecError(str(error.errors()[0]["msg"]).removeprefix("Value error, ")) from error
        self._domain = address.domain
        config = zenoh.Config()
        for key, value in {
            "mode": "client",
            "connect/endpoints": [address.endpoint],
            "connect/timeout_ms": 2000,
            "connect/exit_on_failure": True,
            "scouting/multicast/enabled": False,
            "transport/shared_memory/enabled": False,
            # Advanced publishers number their messages by it.
            "timestamping/enabled": True,
        }.items():
            config.insert_json5(key, json.dumps(value))
        try:
            self.session = zenoh.open(config)
        except zenoh.ZError as error:
            message = (
                f"no Zenoh router at {address.endpoint}: start one, e.g. ros2 run rmw_zenoh_cpp rmw_zenohd"
            )
            raise NoRouterError(message) from error
        self._id = str(self.session.info.zid())
        self._nodes: dict[str, RosNode] = {}
        self._entities = 0
        self._declared: list[Any] = []

    def node(self, name: str) -> RosNode:
        """Our node of that name, announced."""
        if name not in self._nodes:
            node = RosNode(self._domain, self._id, self._number(), name)
            self._declared.append(self.session.liveliness().declare_token(node.token))
            self._nodes[name] = node
        return self._nodes[name]

    def publisher(self, node: str, topic: str, message_type: str, qos: Qos) -> Publisher:
        """A publisher of a node on an absolute name, announced."""
        token = self.node(node).endpoint_token(self._number(), "MP", topic, message_type, qos)
        publisher = Publisher(self.session, data_key(self._domain, topic, message_type), token, qos)
        self._declared.append(publisher)
        return publisher

    def subscribe(
        self, node: str, topic: str, message_type: str, qos: Qos, take: Callable[[zenoh.Sample], None]
    ) -> None:
        """A subscription of a node, announced; ``take``, on Zenoh's thread, may only hand over."""
        key = data_key(self._domain, topic, message_type)
        self._declared.append(self.session.declare_subscriber(key, hand_over(take)))
        token = self.node(node).endpoint_token(self._number(), "MS", topic, message_type, qos)
        self._declared.append(self.session.liveliness().declare_token(token))

    def has(self, kind: Literal["MP", "MS"], topic: str) -> bool:
        """Whether a node of the domain, not one of ours, has such an endpoint on an absolute name."""
        tokens = f"{ADMIN_SPACE}/{self._domain}/*/*/*/{kind}/*/*/*/{mangled(topic)}/**"
        found = self.session.liveliness().get(tokens, timeout=1.0)
        sessions = [str(reply.ok.key_expr).split("/")[2] for reply in found if reply.ok is not None]
        return any(one != self._id for one in sessions)

    def _number(self) -> int:
        """The next number of a node or an endpoint: each has its own in the session."""
        self._entities += 1
        return self._entities - 1

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.session.close()  # type: ignore[no-untyped-call]
