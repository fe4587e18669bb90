"""rmw_zenoh's scheme: what ROS 2 over Zenoh calls a topic, stamps a message with and announces itself by.

Source: the design document of rmw_zenoh, "Topic and Service name mapping", "Graph Cache" and "Publishers".
"""

from __future__ import annotations

import struct
from typing import Literal, NamedTuple

from services.bus.messages import type_hash
from services.bus.topics import Topic

ADMIN_SPACE = "@ros2_lv"
"""Where liveliness tokens stand; no wildcard but one behind it matches."""

GID_BYTES = 16
DEFAULT_DEPTH = 42
"""Of a queue, where a quality of service does not say: rmw_zenoh's own default."""

_ATTACHMENT = struct.Struct(f"<qqB{GID_BYTES}s")


class Attachment(NamedTuple):
    """What goes with a message: its number, when it was made (ns), and the publisher's identity."""

    seq: int
    source_ns: int
    gid: bytes

    def packed(self) -> bytes:
        """The attachment as the bytes that rmw_zenoh sends."""
        return _ATTACHMENT.pack(self.seq, self.source_ns, len(self.gid), self.gid)

    @classmethod
    def split(cls, raw: bytes) -> tuple[Attachment, bytes]:
        """The attachment in such bytes, and what follows it.

        :raises ValueError: if they are too few.
        """
        return cls.unpacked(raw[: _ATTACHMENT.size]), raw[_ATTACHMENT.size :]

    @classmethod
    def unpacked(cls, raw: bytes) -> Attachment:
        """The attachment in such bytes.

        :raises ValueError: if they are not of that form.
        """
        if len(raw) != _ATTACHMENT.size:
            message = f"attachment of {len(raw)} bytes, expected {_ATTACHMENT.size}"
            raise ValueError(message)
        seq, source_ns, _, gid = _ATTACHMENT.unpack(raw)
        return cls(seq, source_ns, gid)


class Qos(NamedTuple):
    """The part of a quality of service that we use; the history is "keep last"."""

    reliable: bool = True
    transient_local: bool = False
    depth: int = DEFAULT_DEPTH

    @property
    def text(self) -> str:
        """The quality of service as it stands in a liveliness token; defaults are left out."""
        reliability = "" if self.reliable else "2"
        durability = "1" if self.transient_local else ""
        depth = "" if self.depth == DEFAULT_DEPTH else str(self.depth)
        return f"{reliability}:{durability}:,{depth}:,:,:,,"


def quality(topic: Topic) -> Qos:
    """The quality of service that a topic of ours has in ROS."""
    latched = topic.qos == "latched"
    return Qos(transient_local=latched, depth=1 if latched else 10)


class RosNode(NamedTuple):
    """A node as the ROS graph knows it; ``session`` is the id of its Zenoh session."""

    domain: int
    session: str
    number: int
    name: str
    namespace: str = "/"

    @property
    def token(self) -> str:
        """The key of its liveliness token."""
        return self._token(self.number, "NN")

    def endpoint_token(
        self, number: int, kind: Literal["MP", "MS"], topic: str, message_type: str, qos: Qos
    ) -> str:
        """The key of the token of a publisher (MP) or a subscription (MS) on the absolute name ``topic``."""
        described = f"{mangled(topic)}/{dds_type(message_type)}/{type_hash(message_type)}/{qos.text}"
        return f"{self._token(number, kind)}/{described}"

    def _token(self, number: int, kind: str) -> str:
        head = f"{ADMIN_SPACE}/{self.domain}/{self.session}/{self.number}/{number}/{kind}"
        return f"{head}/{mangled('/')}/{mangled(self.namespace)}/{self.name}"


def mangled(name: str) -> str:
    """A name as one chunk of a key."""
    return name.replace("/", "%")


def dds_type(message_type: str) -> str:
    """``package/msg/Name`` as DDS has it."""
    package, kind, short = message_type.split("/")
    return f"{package}::{kind}::dds_::{short}_"


def data_key(domain: int, topic: str, message_type: str) -> str:
    """Where the messages of a topic go: ``<domain>/<topic>/<DDS type>/<type hash>``."""
    return f"{domain}/{topic.strip('/')}/{dds_type(message_type)}/{type_hash(message_type)}"
