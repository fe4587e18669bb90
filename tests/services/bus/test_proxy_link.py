"""What a node says and is answered arrives whole, in order, and nonsense is told from it."""

import socket
from collections.abc import Iterator

import pytest

from services.bus import proxy_link
from services.bus.horizon import Stamped
from services.bus.proxy_link import HungUpError, NodeLink, NonsenseError, ProxyLink, pack, unpack

Ends = tuple[NodeLink, ProxyLink, socket.socket, socket.socket]


@pytest.fixture
def ends() -> Iterator[Ends]:
    node, proxy = socket.socketpair()
    with node, proxy:
        yield NodeLink(node), ProxyLink(proxy), node, proxy


def test_what_is_told_goes_out_in_order_with_the_next_question(ends: Ends) -> None:
    node, proxy, _, end = ends
    proxy.answer(7, 2, b"answer")
    node.tell(proxy_link.PUT, 3, -5, payload=b"message")
    node.tell(proxy_link.PROMISE, 0, 2**62, -1)
    end.setblocking(False)
    with pytest.raises(BlockingIOError):
        proxy.hear()
    end.setblocking(True)
    assert node.ask(proxy_link.NEXT, 1, 40_000_000) == (7, 2, b"answer")
    assert proxy.hear() == (proxy_link.PUT, 3, -5, 0, b"message")
    assert proxy.hear() == (proxy_link.PROMISE, 0, 2**62, -1, b"")
    assert proxy.hear() == (proxy_link.NEXT, 1, 40_000_000, 0, b"")


def test_what_a_node_said_before_it_died_is_heard(ends: Ends) -> None:
    node, proxy, end, _ = ends
    proxy.answer(1)  # which it never reads
    node.tell(proxy_link.PUT, 3, 0, payload=b"last words")
    node.send()
    end.sendall(b"\0\0half a frame")
    end.close()
    last = proxy.hear()
    assert last is not None
    assert last.payload == b"last words"
    assert proxy.hear() is None
    proxy.answer(1)  # in vain


@pytest.mark.parametrize("frame", [b"\xff" + bytes(23), bytes(4) + b"\xff\xff\xff\xff" + bytes(16)])
def test_nonsense_is_told_from_frames(frame: bytes, ends: Ends) -> None:
    _, proxy, end, _ = ends
    end.sendall(frame)
    with pytest.raises(NonsenseError):
        proxy.hear()


def test_a_node_hears_that_its_proxy_is_gone(ends: Ends) -> None:
    node, _, _, end = ends
    end.close()
    with pytest.raises(proxy_link.LinkError):
        node.ask(proxy_link.NEXT)


def test_a_body_holds_its_messages() -> None:
    messages = [(0, Stamped(5, 40, b"five")), (2, Stamped(0, -1, b"")), (2, Stamped(1, 2**62, bytes(9000)))]
    assert list(unpack(pack(messages))) == messages
    assert list(unpack(b"")) == []


def test_a_closed_line_gives_no_part_of_what_was_expected(ends: Ends) -> None:
    _, _, end, other = ends
    end.sendall(b"abc")
    end.close()
    with pytest.raises(HungUpError):
        proxy_link.receive(other, 4)
