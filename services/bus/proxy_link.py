"""The socket protocol between a node and its proxy: reports and requests of the node, answers of the proxy.

A Unix stream socket with frames of fixed form, so that what a node sends and gets, the sizes and the
system calls follow from the flight alone. A node reports (PUT, PROMISE) or asks and waits (the others);
its proxy answers each request once, when the answer is final.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol

from services.bus.horizon import Stamped

READY, PUT, PROMISE, NEXT, ADVANCE, BUSY_UNTIL, ASK = range(7)
"""What a node says. READY: its inputs. PUT: ``place`` of a topic, ``first`` when it is ready. PROMISE:
``first`` the earliest next activation, ``second`` busy until then. NEXT: ``place`` of the trigger among the
inputs, ``first`` busy until then. ADVANCE: ``first`` until. BUSY_UNTIL: ``place`` of a stage, ``first`` the
trigger that it is to have dealt with. ASK: key, zero byte, payload; ``first`` the time-out in ns."""

_AT_ONCE = 1 << 16
LARGEST = 1 << 28
"""Bytes of a frame beyond which it is none of ours."""

_FRAME = struct.Struct("<BBxxIqq")
ANSWER = struct.Struct("<IIq")
"""Before the body of an answer: the length of the body, and the two numbers of :class:`ProxyAnswer`."""

_MESSAGE = struct.Struct("<BxxxIqq")


class Digest(Protocol):
    """The digest of what is added to it, as hashlib makes them."""

    def update(self, more: bytes, /) -> None:
        """Add some bytes to what the digest is of."""
        ...

    def digest(self) -> bytes:
        """The digest of what was added so far."""
        ...


class LinkError(Exception):
    """The other end of the socket is closed or sends malformed data."""


class Frame(NamedTuple):
    """One frame that a node sends: one of the kinds above, and what goes with it."""

    kind: int
    place: int
    first: int
    second: int
    payload: bytes


class ProxyAnswer(NamedTuple):
    """The proxy's answer to a request of the node: two numbers, and bytes."""

    value: int
    dropped: int
    body: bytes


class NodeLink:
    """The node's end of the socket between a node and its proxy."""

    def __init__(self, end: socket.socket) -> None:
        self._socket = end
        self._queued: list[bytes] = []

    def tell(self, kind: int, place: int = 0, first: int = 0, second: int = 0, payload: bytes = b"") -> None:
        """Queue a frame that needs no answer. It is sent with the next request, or by :meth:`send`."""
        self._queued.append(_FRAME.pack(kind, place, len(payload), first, second))
        self._queued.append(payload)

    def send(self) -> None:
        """Send all frames that are queued.

        :raises LinkError: if the proxy is gone.
        """
        if not self._queued:
            return
        frames = b"".join(self._queued)
        self._queued.clear()
        try:
            self._socket.sendall(frames)
        except OSError as error:
            raise LinkError("the proxy is gone") from error

    def ask(
        self, kind: int, place: int = 0, first: int = 0, second: int = 0, payload: bytes = b""
    ) -> ProxyAnswer:
        """Send a request to the proxy and wait for its answer.

        :raises LinkError: if the proxy is gone.
        """
        self.tell(kind, place, first, second, payload)
        self.send()
        size, dropped, value = ANSWER.unpack(receive(self._socket, ANSWER.size))
        return ProxyAnswer(value, dropped, receive(self._socket, size) if size else b"")

    def fileno(self) -> int:
        """The descriptor of the socket; frames that are queued have not passed it yet."""
        return self._socket.fileno()

    def close(self) -> None:
        """Send what is queued and close the socket."""
        self.send()
        self._socket.close()


class OverheardLink(NodeLink):
    """A node's end of the socket; what is told is added to a digest, too."""

    def __init__(self, link: NodeLink, digest: Digest) -> None:
        self._link, self._digest = link, digest

    def tell(self, kind: int, place: int = 0, first: int = 0, second: int = 0, payload: bytes = b"") -> None:
        """Add a frame to the digest and queue it."""
        self._digest.update(_FRAME.pack(kind, place, len(payload), first, second))
        self._digest.update(payload)
        self._link.tell(kind, place, first, second, payload)

    def send(self) -> None:
        """Send all frames that are queued."""
        self._link.send()


class SilentLink(NodeLink):
    """The end of no socket: what is told is heard by nobody. Nothing may be asked."""

    def __init__(self) -> None: ...

    def tell(self, kind: int, place: int = 0, first: int = 0, second: int = 0, payload: bytes = b"") -> None:
        """Forget the frame, which nobody is to hear."""

    def send(self) -> None:
        """Send nothing, for nothing is queued."""


class ProxyLink:
    """The proxy's end of the socket between a node and its proxy."""

    def __init__(self, end: socket.socket) -> None:
        self._socket = end
        self._heard = b""

    @property
    def pending(self) -> bool:
        """Whether something has come that is not heard yet."""
        return bool(self._heard)

    def hear(self) -> Frame | None:
        """The next frame from the node; None once the node closed the socket or died, even within a frame.

        :raises LinkError: if the frame is malformed.
        """
        try:
            kind, place, size, first, second = _FRAME.unpack(self._take(_FRAME.size))
            if kind > ASK or size > LARGEST:
                message = f"a frame of kind {kind} and {size} bytes"
                raise NonsenseError(message)
            return Frame(kind, place, first, second, self._take(size))
        except HungUpError:
            return None

    def _take(self, size: int) -> bytes:
        """Receive exactly ``size`` bytes; what has come beyond them is kept for the next call."""
        while len(self._heard) < size:
            try:
                more = self._socket.recv(_AT_ONCE)
            except ConnectionResetError:  # it died before it had read our answer
                more = b""
            if not more:
                raise HungUpError("the line is dead")
            self._heard += more
        taken, self._heard = self._heard[:size], self._heard[size:]
        return taken

    def answer(self, value: int, dropped: int = 0, body: bytes = b"") -> None:
        """Send the answer to a request of the node; without effect if the node is dead."""
        try:
            self._socket.sendall(ANSWER.pack(len(body), dropped, value) + body)
        except OSError:
            return  # hear() will return None


def question(key: str, payload: bytes, timeout_s: float) -> bytes:
    """A frame that asks whoever answers for ``key`` on the bus; the answer's value counts the replies."""
    asked = key.encode() + b"\0" + payload
    return _FRAME.pack(ASK, 0, len(asked), round(timeout_s * 1e9), 0) + asked


class NonsenseError(LinkError):
    """A node sent a frame of an unknown kind or of too many bytes."""


class HungUpError(LinkError):
    """The other end of the socket was closed."""


def receive(end: socket.socket, size: int) -> bytes:
    """So many bytes: in one system call, unless a debugger comes between.

    :raises HungUpError: if there are no more.
    """
    got = b""
    while len(got) < size:
        more = end.recv(size - len(got), socket.MSG_WAITALL)
        if not more:
            raise HungUpError("the line is dead")
        got = got + more if got else more
    return got


def pack(messages: Sequence[tuple[int, Stamped]]) -> bytes:
    """The body of an answer: messages, each with the place of its input."""
    parts = []
    for place, one in messages:
        parts.append(_MESSAGE.pack(place, len(one.payload), one.seq, one.ready_ns))
        parts.append(one.payload)
    return b"".join(parts)


def unpack(body: bytes) -> Iterator[tuple[int, Stamped]]:
    """The messages in the body of an answer."""
    at = 0
    while at < len(body):
        place, size, seq, ready_ns = _MESSAGE.unpack_from(body, at)
        at += _MESSAGE.size + size
        yield place, Stamped(seq, ready_ns, body[at - size : at])
