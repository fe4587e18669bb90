"""Flights are shown live over Foxglove's protocol, and never wait for who watches."""

import json
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from dashboard.analysis.recordings_reader import open_run
from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from deploy.recording.live_feed import END, LONGEST_BYTES, SOCKET, LiveFeedReader, MalformedFeedError
from services.bus.messages import TYPESTORE
from services.models.mission import Limits
from tests.conftest import PATIENCE_S, wait_until
from tests.dashboard.recorded import GOLDEN
from tests.fixtures.another_user import NOBODY, needs_root, user

ZENFI = str(Path(sys.executable).parent / "zenfi")
SHORT = GOLDEN.model_copy(update={"limits": Limits(mission_time_s=4.0)})
MESSAGE = 1
HEAD = struct.Struct("<BIQ")


@contextmanager
def foxglove(folder: Path) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """The server of a store, and its port."""
    command = [ZENFI, "foxglove", "--port", "0", "--store", str(folder)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            told = next(line for line in process.stderr if "ws://127.0.0.1:" in line)
            yield process, int(told.split("127.0.0.1:")[1].split()[0])
        finally:
            process.kill()


def watching(port: int) -> AbstractContextManager[ClientConnection]:
    return connect(f"ws://127.0.0.1:{port}", subprotocols=[Subprotocol("foxglove.sdk.v1")], max_size=None)


class Watching:
    """A client of Foxglove's protocol: JSON for what there is, binary for messages."""

    def __init__(self, line: ClientConnection, *topics: str) -> None:
        self.line = line
        self.channels: dict[str, dict[str, str]] = {}
        while not set(topics) <= set(self.channels):
            told = self.line.recv(20.0)
            if isinstance(told, str) and json.loads(told)["op"] == "advertise":
                self.channels |= {one["topic"]: one for one in json.loads(told)["channels"]}
        self.topics = topics
        wanted = [{"id": place, "channelId": self.channels[name]["id"]} for place, name in enumerate(topics)]
        self.line.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        self._meanwhile = list(self._until_subscribed())

    def _until_subscribed(self) -> Iterator[bytes]:
        """What comes before the answer to a request that was sent later: subscribing has no answer."""
        self.line.send(json.dumps({"op": "getParameters", "parameterNames": [], "id": "subscribed"}))
        while isinstance(told := self.line.recv(20.0), bytes) or json.loads(told)["op"] != "status":
            if isinstance(told, bytes):
                yield told

    def messages(self) -> Iterator[tuple[str, int, bytes]]:
        """Topic, time and bytes of each message."""
        while True:
            told = self._meanwhile.pop(0) if self._meanwhile else self.line.recv(20.0)
            if isinstance(told, bytes) and told[0] == MESSAGE:
                _, place, time_ns = HEAD.unpack_from(told)
                yield self.topics[place], time_ns, told[HEAD.size :]


def test_a_client_sees_the_flight_and_a_late_one_what_stands(server: ForkServer, tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    with foxglove(tmp_path) as (_, port), watching(port) as line, watching(port) as later:
        early = Watching(line, "/odometry", "/obstacles", "/tf")
        PairFlyer(server).fly(SHORT, path, live=tmp_path / SOCKET)
        recorded = open_run(path)
        wanted = {topic: recorded.messages[topic.removeprefix("/")] for topic in early.topics}
        seen: dict[str, list[tuple[int, bytes]]] = {topic: [] for topic in early.topics}
        for topic, time_ns, payload in early.messages():
            seen[topic].append((time_ns, payload))
            if len(seen["/tf"]) == len(wanted["/tf"]):
                break
        for topic in early.topics:
            assert seen[topic] == [(one.ready_ns, one.payload) for one in wanted[topic]]
        channel = early.channels["/odometry"]
        assert (channel["encoding"], channel["schemaName"]) == ("cdr", "nav_msgs/msg/Odometry")
        assert channel["schema"] == TYPESTORE.generate_msgdef("nav_msgs/msg/Odometry", ros_version=2)[0]
        late = Watching(later, "/obstacles")
        topic, _, payload = next(late.messages())
        assert (topic, payload) == ("/obstacles", wanted["/obstacles"][0].payload)


def test_no_flight_waits_for_a_server_that_is_stopped_or_gone(server: ForkServer, tmp_path: Path) -> None:
    alone = PairFlyer(server).fly(SHORT)
    with foxglove(tmp_path) as (process, _):
        os.kill(process.pid, signal.SIGSTOP)
        assert PairFlyer(server).fly(SHORT, live=tmp_path / SOCKET).digest == alone.digest
        os.kill(process.pid, signal.SIGCONT)
    assert PairFlyer(server).fly(SHORT, live=tmp_path / SOCKET).digest == alone.digest


def is_free(folder: Path) -> bool:
    """Whether the server would show a flight now."""
    with socket.socket(socket.AF_UNIX) as feed:
        feed.connect(str(folder / SOCKET))
        feed.settimeout(0.2)
        try:
            return feed.recv(1) != b""  # who is turned away is hung up on
        except TimeoutError:
            return True


@needs_root
def test_nothing_more_is_shown_once_another_user_is_connected(server: ForkServer, tmp_path: Path) -> None:
    path, next_one = tmp_path / "flight.mcap", SHORT.model_copy(update={"seed": SHORT.seed + 1})
    with foxglove(tmp_path) as (process, port), watching(port) as line:
        mine = Watching(line, "/odometry")
        with user(NOBODY):
            stranger = socket.create_connection(("127.0.0.1", port))
        with stranger:
            PairFlyer(server).fly(SHORT, live=tmp_path / SOCKET)
            assert process.stderr is not None
            assert f"nothing more of this flight is shown: user {NOBODY}" in process.stderr.readline()
        wait_until(lambda: is_free(tmp_path), PATIENCE_S)
        time.sleep(0.5)  # until it has noticed that we are gone
        PairFlyer(server).fly(next_one, path, live=tmp_path / SOCKET)
        recorded = open_run(path).messages["odometry"]
        seen = [payload for _, (_, _, payload) in zip(recorded, mine.messages(), strict=False)]
        assert seen == [one.payload for one in recorded]


def test_it_listens_to_this_machine_and_this_user_alone(tmp_path: Path) -> None:
    with foxglove(tmp_path) as (process, port):
        with pytest.raises(ConnectionRefusedError), socket.create_connection(("127.0.0.2", port)):
            pass
        assert (tmp_path / SOCKET).stat().st_mode & 0o077 == 0
        second = subprocess.run(
            [ZENFI, "foxglove", "--port", "0", "--store", str(tmp_path)],
            capture_output=True,
            text=True,
            check=False,
        )
        assert second.returncode == 2
        assert second.stderr.startswith("zenfi: ")
        assert "another process shows" in second.stderr
        with socket.socket(socket.AF_UNIX) as feed:  # who talks nonsense is turned away, and nothing else
            feed.connect(str(tmp_path / SOCKET))
            feed.sendall(b"\xf0" * 100)
            feed.settimeout(20.0)
            assert feed.recv(1) == b""
        process.send_signal(signal.SIGTERM)
        assert process.wait(20.0) == 0
    assert not (tmp_path / SOCKET).exists()


def test_frames_are_checked() -> None:
    with pytest.raises(MalformedFeedError, match="topic 200"):
        list(LiveFeedReader().hear(struct.pack("<BqqI", 200, 0, 0, 0)))
    with pytest.raises(MalformedFeedError, match="bytes"):
        list(LiveFeedReader().hear(struct.pack("<BqqI", END, 0, 0, LONGEST_BYTES + 1)))
