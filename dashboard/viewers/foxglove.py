"""Live flights in Foxglove: ``zenfi foxglove`` serves its WebSocket protocol. Needs ``zenfi[foxglove]``.

Flights offer themselves over a Unix socket in the store's folder (``deploy/recording/live_feed.py``); one at
a time is shown. Clients get what they can take: the server drops the oldest message that waits for a slow
one.
"""

from __future__ import annotations

import contextlib
import queue
import selectors
import socket
import sys
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from pydantic import ValidationError

from deploy.errors import BadSpecError
from deploy.recording.derived import DERIVED, DerivedMessages
from deploy.recording.live_feed import SOCKET, LiveFeedReader, MalformedFeedError
from deploy.recording.ordering import TYPES, SentMessage
from services.bus.messages import TYPESTORE
from services.bus.topics import TOPICS
from services.system.peers import strangers

HOST = "127.0.0.1"
BACKLOG = 4096
"""Messages that wait for one client."""

READ_BYTES = 1 << 18
LOOK_S = 0.25
"""Between two looks for clients that have subscribed."""

_ALL: Mapping[str, str] = MappingProxyType({**TYPES, **{name: one.type for name, one in DERIVED.items()}})
_STREAMS = {
    *(name for name, topic in TOPICS.items() if topic.qos == "stream"),
    *(name for name, topic in DERIVED.items() if not topic.quality.transient_local),
    "alarm",
}


class FoxgloveChannels:
    """The channels of a Foxglove server, and what a client that comes late is to be told again."""

    def __init__(self, port: int) -> None:
        foxglove = _sdk()
        self._subscribed: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.server = foxglove.start_server(
            name="zenfi",
            host=HOST,
            port=port,
            capabilities=[foxglove.Capability.Time],
            server_listener=_listener(foxglove, self._subscribed),
            supported_encodings=["cdr"],
            message_backlog_size=BACKLOG,
        )
        self._channels = {topic: _channel(foxglove, topic, kind) for topic, kind in _ALL.items()}
        self._latched: dict[str, SentMessage] = {}

    def begin(self) -> None:
        """Another flight begins: clients forget the one before."""
        self._latched = {}
        self.server.clear_session()

    def show(self, sent: SentMessage) -> None:
        """Send a message of the flight to the clients."""
        if sent.topic not in _STREAMS:
            self._latched[sent.topic] = sent
        if sent.topic == "odometry":
            self.server.broadcast_time(sent.message.ready_ns)
        self._log(sent)

    def catch_up(self) -> None:
        """Tell again what clients that have just subscribed should have heard."""
        while not self._subscribed.empty():
            topic = self._subscribed.get().removeprefix("/")
            if topic in self._latched:
                self._log(self._latched[topic])

    def _log(self, sent: SentMessage) -> None:
        self._channels[sent.topic].log(sent.message.payload, log_time=max(sent.message.ready_ns, 0))


class FlightStage:
    """Shows one flight after the other; who comes while another is shown is turned away."""

    def __init__(self, folder: Path, shown: FoxgloveChannels) -> None:
        self._shown = shown
        self._door = _listen(folder / SOCKET)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._door, selectors.EVENT_READ)
        self._feed: socket.socket | None = None
        self._hearing = LiveFeedReader()
        self._derived: DerivedMessages | None = None
        self._withheld = False

    def run(self) -> None:
        """Send messages until an exception ends it."""
        try:
            while True:
                events = self._selector.select(LOOK_S)
                self._look_for_strangers()
                for key, _ in events:
                    self._admit() if key.fileobj is self._door else self._hear()
                self._shown.catch_up()
        finally:
            self._leave()
            self._selector.close()
            Path(self._door.getsockname()).unlink(missing_ok=True)
            self._door.close()

    def _look_for_strangers(self) -> None:
        """Show nothing more of a flight once another user's program is connected: it asks for no password."""
        if not self._withheld and (users := strangers((HOST, self._shown.server.port))):
            told = f"nothing more of this flight is shown: user {', '.join(map(str, users))} is connected"
            print(told, file=sys.stderr, flush=True)  # noqa: T201
            self._withheld = True
            self._shown.begin()

    def _admit(self) -> None:
        feed, _ = self._door.accept()
        if self._feed is not None:
            feed.close()
            return
        self._selector.register(feed, selectors.EVENT_READ)
        self._feed, self._hearing, self._derived = feed, LiveFeedReader(), None
        self._withheld = False
        self._shown.begin()

    def _hear(self) -> None:
        assert self._feed is not None  # noqa: S101 - it is registered
        try:
            data = self._feed.recv(READ_BYTES)
            for sent in self._hearing.hear(data):
                if not self._withheld:
                    self._show(sent)
        except (OSError, MalformedFeedError, ValidationError) as error:
            print(f"feed refused: {error}", file=sys.stderr)  # noqa: T201 - the supervisor keeps it
            data = b""
        if not data:
            self._leave()

    def _show(self, sent: SentMessage) -> None:
        if self._derived is None:
            assert self._hearing.spec is not None  # noqa: S101 - it comes first
            self._derived = DerivedMessages(self._hearing.spec)
        self._shown.show(sent)
        for made in self._derived.of(sent):
            self._shown.show(made)

    def _leave(self) -> None:
        feed, self._feed = self._feed, None  # first: a signal may end this anywhere, and run() leaves again
        if feed is None:
            return
        if self._hearing.dropped:
            print(f"the flight dropped {self._hearing.dropped} messages", file=sys.stderr)  # noqa: T201
        self._selector.unregister(feed)
        feed.close()


def serve(folder: Path, port: int) -> None:
    """Serve Foxglove clients until SIGINT.

    :raises BadSpecError: if the SDK is not installed, the port is taken or another serves this store.
    """
    try:
        shown = FoxgloveChannels(port)
    except RuntimeError as error:
        message = f"--port {port}: {error}"
        raise BadSpecError(message) from error
    try:
        stage = FlightStage(folder, shown)
        print(f"open ws://127.0.0.1:{shown.server.port} in Foxglove", file=sys.stderr, flush=True)  # noqa: T201
        stage.run()
    finally:
        shown.server.stop()


def _sdk() -> Any:
    try:
        import foxglove  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise BadSpecError("live flights in Foxglove need its SDK: pip install 'zenfi[foxglove]'") from error
    return foxglove


def _listener(foxglove: Any, subscribed: queue.SimpleQueue[str]) -> Any:
    class Listener(foxglove.ServerListener):  # type: ignore[misc]
        """Hears on the server's thread, where nothing may be logged."""

        def on_subscribe(self, client: Any, channel: Any) -> None:  # noqa: ARG002 - the SDK's
            subscribed.put(channel.topic)

    return Listener()


def _channel(foxglove: Any, topic: str, kind: str) -> Any:
    text, _ = TYPESTORE.generate_msgdef(kind, ros_version=2)
    schema = foxglove.Schema(name=kind, encoding="ros2msg", data=text.encode())
    return foxglove.Channel(f"/{topic}", schema=schema, message_encoding="cdr")


def _listen(path: Path) -> socket.socket:
    """The socket that flights offer themselves at; only this user can reach it.

    :raises BadSpecError: if another serves there, or it cannot be had.
    """
    door = socket.socket(socket.AF_UNIX)
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as visitor:
        visitor.connect(str(path))
        message = f"{path}: another process shows the flights of this store"
        raise BadSpecError(message)
    try:
        path.unlink(missing_ok=True)
        door.bind(str(path))
        path.chmod(0o600)
        door.listen()
    except OSError as error:
        door.close()
        message = f"{path}: {error.strerror or error}"
        raise BadSpecError(message) from error
    return door
