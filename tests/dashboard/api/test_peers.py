"""Whose a connection is."""

import contextlib
import os
import socket
from collections.abc import Iterator

import httpx
import pytest

from dashboard.api.peers import peer_uid
from tests.dashboard.api.conftest import Serving
from tests.fixtures.another_user import NOBODY

needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can be somebody else")


@contextlib.contextmanager
def user(uid: int) -> Iterator[None]:
    """Sockets that are made in here are that user's."""
    os.seteuid(uid)
    try:
        yield
    finally:
        os.seteuid(0)


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2", "::1"])
def test_a_connection_is_whose_process_made_it(host: str) -> None:
    with (
        socket.create_server((host, 0), family=_family(host)) as listening,
        socket.create_connection(listening.getsockname()[:2]) as client,
    ):
        ours, peer = listening.accept()
        with ours:
            assert peer_uid(peer[:2], ours.getsockname()[:2]) == os.getuid()
            assert peer_uid((host, 1), ours.getsockname()[:2]) is None
            client.close()
            # Listed as root's from here on.
            assert peer_uid(peer[:2], ours.getsockname()[:2]) is None


def _family(host: str) -> int:
    return socket.AF_INET6 if ":" in host else socket.AF_INET


@needs_root
def test_it_stays_whose_it_was_when_made(one_loopback_pair: tuple[socket.socket, socket.socket]) -> None:
    ours, theirs = one_loopback_pair
    assert peer_uid(theirs.getsockname(), ours.getsockname()) == NOBODY


@pytest.fixture
def one_loopback_pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    """A connection that user nobody made."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        with user(NOBODY):
            theirs = socket.create_connection(listening.getsockname())
        ours, _ = listening.accept()
        with theirs, ours:
            yield ours, theirs


REQUEST = b'{"preset": "demo"}'
CREATE = (
    b"POST /api/v1/campaigns HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    b"Content-Length: %d\r\n\r\n%b" % (len(REQUEST), REQUEST)
)


@needs_root
def test_another_account_on_the_machine_reads_and_starts_nothing(service: Serving) -> None:
    host, port = service.address.removeprefix("http://").split(":")
    with user(NOBODY):
        asking = socket.create_connection((host, int(port)))
    with asking:
        asking.sendall(CREATE)
        assert asking.recv(1000).startswith(b"HTTP/1.1 401 ")
    for _ in range(50):  # gone before it is asked whose the request is
        with user(NOBODY):
            leaving = socket.create_connection((host, int(port)))
        leaving.sendall(CREATE)
        leaving.close()
    names = [one["campaign"] for one in httpx.get(f"{service.address}/api/v1/campaigns").json()["campaigns"]]
    assert not [name for name in names if name.startswith("demo")]
