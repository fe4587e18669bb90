"""Whose a connection is."""

import os
import socket
from collections.abc import Iterator

import pytest

from services.system.peers import peer_uid, strangers
from tests.fixtures.another_user import NOBODY, needs_root, user


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


@needs_root
def test_who_else_is_connected_is_known(one_loopback_pair: tuple[socket.socket, socket.socket]) -> None:
    ours, theirs = one_loopback_pair
    with socket.create_connection(ours.getsockname()):  # by ourselves
        assert strangers(ours.getsockname()) == {NOBODY}
        theirs.close()
        assert strangers(ours.getsockname()) == set()


@pytest.fixture
def one_loopback_pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    """A connection that user nobody made."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        with user(NOBODY):
            theirs = socket.create_connection(listening.getsockname())
        ours, _ = listening.accept()
        with theirs, ours:
            yield ours, theirs
