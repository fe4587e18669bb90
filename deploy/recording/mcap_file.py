"""Messages in an MCAP file: ROS 2 CDR with their schemas, so that whoever reads it needs nothing of ours."""

from __future__ import annotations

from collections.abc import Mapping
from typing import IO

from mcap.writer import CompressionType, Writer

from services.bus.horizon import Stamped
from services.bus.messages import TYPESTORE, type_hash
from services.bus.ros2 import Qos

CHUNK_BYTES = 500_000
"""Before compression. A chunk is closed by the message that fills it, and is to stay below 1 MB: the longest
message, a cloud of the paper's camera, has 440 kB."""

METADATA = "zenfi"
"""Name of the metadata records: at the beginning what was flown, at the end what became of it."""

_QOS = """- history: 1
  depth: {depth}
  reliability: 1
  durability: {durability}
  deadline: {{sec: 9223372036, nsec: 854775807}}
  lifespan: {{sec: 9223372036, nsec: 854775807}}
  liveliness: 1
  liveliness_lease_duration: {{sec: 9223372036, nsec: 854775807}}
  avoid_ros_namespace_conventions: false
"""
"""As rosbag2 writes it: keep the last ones, reliable, no deadline; transient local (1) or volatile (2)."""


class McapFile:
    """Writes one file. Schemas and channels come with the first message of their topic."""

    def __init__(self, stream: IO[bytes], about: Mapping[str, str]) -> None:
        self._stream = stream
        self._writer = Writer(stream, CHUNK_BYTES, CompressionType.ZSTD)
        self._writer.start("ros2", "zenfi")
        self._writer.add_metadata(METADATA, dict(about))
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def write(self, topic: str, message_type: str, quality: Qos, message: Stamped) -> None:
        """Write one message; its time in the file is the virtual time at which it was ready."""
        if topic not in self._channels:
            self._channels[topic] = self._channel(topic, message_type, quality)
        self._writer.add_message(
            self._channels[topic],
            message.ready_ns,
            message.payload,
            publish_time=message.ready_ns,
            sequence=message.seq,
        )

    def flush(self) -> None:
        """Hand complete chunks to the system, which keeps them should we be killed."""
        self._stream.flush()

    def finish(self, about: Mapping[str, str]) -> None:
        """Write the outcome of the flight and the file's index."""
        self._writer.add_metadata(METADATA, dict(about))
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.flush()

    def _channel(self, topic: str, message_type: str, quality: Qos) -> int:
        if message_type not in self._schemas:
            text, _ = TYPESTORE.generate_msgdef(message_type, ros_version=2)
            self._schemas[message_type] = self._writer.register_schema(message_type, "ros2msg", text.encode())
        durability = 1 if quality.transient_local else 2
        metadata = {
            "offered_qos_profiles": _QOS.format(depth=quality.depth, durability=durability),
            "topic_type_hash": type_hash(message_type),
        }
        return self._writer.register_channel(f"/{topic}", "cdr", self._schemas[message_type], metadata)
