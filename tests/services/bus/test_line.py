"""What a node says and is answered arrives whole, in order, and nonsense is told from it."""

import socket
from collections.abc import Iterator

import pytest

from services.bus import line
from services.bus.horizon import Stamped
from services.bus.line import CourierLine, HungUpError, Line, NonsenseError, pack, unpack

Ends = tuple[Line, CourierLine, socket.socket, socket.socket]


@pytest.fixture
def ends() -> Iterator[Ends]:
    node, courier = socket.socketpair()
    with node, courier:
        yield Line(node), CourierLine(courier), node, courier


def test_what_is_told_goes_out_in_order_with_the_next_question(ends: Ends) -> None:
    node, courier, _, end = ends
    courier.answer(7, 2, b"answer")
    node.tell(line.PUT, 3, -5, payload=b"message")
    node.tell(line.PROMISE, 0, 2**62, -1)
    end.setblocking(False)
    with pytest.raises(BlockingIOError):
        courier.hear()
    end.setblocking(True)
    assert node.ask(line.NEXT, 1, 40_000_000) == (7, 2, b"answer")
    assert courier.hear() == (line.PUT, 3, -5, 0, b"message")
    assert courier.hear() == (line.PROMISE, 0, 2**62, -1, b"")
    assert courier.hear() == (line.NEXT, 1, 40_000_000, 0, b"")


def test_what_a_node_said_before_it_died_is_heard(ends: Ends) -> None:
    node, courier, end, _ = ends
    courier.answer(1)  # which it never reads
    node.tell(line.PUT, 3, 0, payload=b"last words")
    node.send()
    end.sendall(b"\0\0half a frame")
    end.close()
    last = courier.hear()
    assert last is not None
    assert last.payload == b"last words"
    assert courier.hear() is None
    courier.answer(1)  # in vain


@pytest.mark.parametrize("frame", [b"\xff" + bytes(23), bytes(4) + b"\xff\xff\xff\xff" + bytes(16)])
def test_nonsense_is_told_from_frames(frame: bytes, ends: Ends) -> None:
    _, courier, end, _ = ends
    end.sendall(frame)
    with pytest.raises(NonsenseError):
        courier.hear()


def test_a_node_hears_that_its_courier_is_gone(ends: Ends) -> None:
    node, _, _, end = ends
    end.close()
    with pytest.raises(line.LineError):
        node.ask(line.NEXT)


def test_a_body_holds_its_messages() -> None:
    messages = [(0, Stamped(5, 40, b"five")), (2, Stamped(0, -1, b"")), (2, Stamped(1, 2**62, bytes(9000)))]
    assert list(unpack(pack(messages))) == messages
    assert list(unpack(b"")) == []


def test_a_closed_line_gives_no_part_of_what_was_expected(ends: Ends) -> None:
    _, _, end, other = ends
    end.sendall(b"abc")
    end.close()
    with pytest.raises(HungUpError):
        line.receive(other, 4)
