"""The live feed: a flight's messages over a Unix socket to whoever shows them; no flight waits for it."""

from __future__ import annotations

import contextlib
import queue
import socket
import struct
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType

from deploy.recording.ordering import TYPES, SentMessage
from services.bus.horizon import Stamped
from services.models.mission import MissionSpec

SOCKET = "live.sock"
"""Name of the socket in the folder of the store whose flights are shown."""

WAITING_BYTES = 8_000_000
"""Of messages that wait for the viewer's server; what comes beyond is dropped, and counted."""

PATIENCE_S = 10.0
"""Wall time after which a server that does not read is given up."""

LONGEST_BYTES = 32_000_000
"""Of one frame."""

END = 255
"""In the place of the topic: the flight is over; the sequence number is how many messages were dropped."""

_HEAD = struct.Struct("<BqqI")  # topic, virtual time, sequence number, length; then the payload
_TOPICS = tuple(TYPES)
_BEGIN = _TOPICS.index("goal")  # of the first frame; its payload is the specification


class MalformedFeedError(ValueError):
    """The feed holds bytes that no flight sends."""


class LiveFeed:
    """Sends one flight to the server at ``path``. If there is none, or it shows another, nothing happens."""

    def __init__(self, path: Path, spec: MissionSpec) -> None:
        self._path = path
        self._spec = spec
        self._queue: queue.SimpleQueue[Sequence[SentMessage] | None] = queue.SimpleQueue()
        self._offered = self._taken = 0  # bytes, each counted by one thread alone
        self._dropped = 0
        self._thread = threading.Thread(target=self._send, name="live feed", daemon=True)

    def __enter__(self) -> LiveFeed:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._queue.put(None)  # the thread ends when all is sent; nobody waits for it

    def offer(self, batch: Sequence[SentMessage]) -> None:
        """Queue messages for the server; drops them if the queue is full. Never waits."""
        size = sum(len(sent.message.payload) for sent in batch)
        if not self._thread.is_alive() or self._offered - self._taken + size > WAITING_BYTES:
            self._dropped += len(batch)
            return
        self._offered += size
        self._queue.put(batch)

    def _send(self) -> None:
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as line:
            line.settimeout(PATIENCE_S)
            line.connect(str(self._path))
            line.sendall(_frame(_BEGIN, 0, 0, self._spec.model_dump_json().encode()))
            while (batch := self._queue.get()) is not None:
                line.sendall(b"".join(frame(sent) for sent in batch))
                self._taken += sum(len(sent.message.payload) for sent in batch)
            line.sendall(_frame(END, 0, self._dropped, b""))


def frame(sent: SentMessage) -> bytes:
    """A message as the bytes that are sent over the socket."""
    message = sent.message
    return _frame(_TOPICS.index(sent.topic), message.ready_ns, message.seq, message.payload)


def _frame(topic: int, ready_ns: int, seq: int, payload: bytes) -> bytes:
    return _HEAD.pack(topic, ready_ns, seq, len(payload)) + payload


class LiveFeedReader:
    """The server's end: parses bytes as they come. ``spec`` is known after the first frame."""

    def __init__(self) -> None:
        self._heard = b""
        self.spec: MissionSpec | None = None
        self.dropped: int | None = None
        """Once the flight is over."""

    def hear(self, data: bytes) -> Iterator[SentMessage]:
        """Parse received bytes; yields the messages that are complete.

        :raises MalformedFeedError: if no flight sends such bytes.
        """
        self._heard += data
        place = 0
        while len(self._heard) >= place + _HEAD.size:
            topic, ready_ns, seq, length = _HEAD.unpack_from(self._heard, place)
            if length > LONGEST_BYTES or not (topic < len(_TOPICS) or topic == END):
                message = f"a frame of topic {topic} with {length} bytes"
                raise MalformedFeedError(message)
            end = place + _HEAD.size + length
            if len(self._heard) < end:
                break
            payload, place = self._heard[place + _HEAD.size : end], end
            if self.spec is None:
                self.spec = MissionSpec.model_validate_json(payload)
            elif topic == END:
                self.dropped = seq
            else:
                yield SentMessage(_TOPICS[topic], Stamped(seq, ready_ns, payload))
        self._heard = self._heard[place:]
