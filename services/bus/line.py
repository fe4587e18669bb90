"""The line between a node and its courier: what a node asks and tells, and what it is answered.

A Unix stream socket with frames of fixed form, so that what a node sends and gets, the sizes and the
system calls follow from the flight alone. A node tells (PUT, PROMISE) or asks and waits (the others); its
courier answers each question once, when it is settled.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator, Sequence
from typing import NamedTuple

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
"""Of an answer before its body: the body's length, and the two numbers of :class:`Answer`, the value last."""

_MESSAGE = struct.Struct("<BxxxIqq")


class LineError(Exception):
    """The other end is gone or talks nonsense."""


class Frame(NamedTuple):
    """What a node says: one of the kinds above, and what goes with it."""

    kind: int
    place: int
    first: int
    second: int
    payload: bytes


class Answer(NamedTuple):
    """What a node is answered: two numbers, and bytes."""

    value: int
    dropped: int
    body: bytes


class Line:
    """The node's end."""

    def __init__(self, end: socket.socket) -> None:
        self._socket = end
        self._told: list[bytes] = []

    def tell(self, kind: int, place: int = 0, first: int = 0, second: int = 0, payload: bytes = b"") -> None:
        """Say something that needs no answer. It goes out with the next question, or :meth:`send`."""
        self._told.append(_FRAME.pack(kind, place, len(payload), first, second))
        self._told.append(payload)

    def send(self) -> None:
        """Let out what was told.

        :raises LineError: if the courier is gone.
        """
        if not self._told:
            return
        frames = b"".join(self._told)
        self._told.clear()
        try:
            self._socket.sendall(frames)
        except OSError as error:
            raise LineError("the courier is gone") from error

    def ask(self, kind: int, place: int = 0, first: int = 0, second: int = 0, payload: bytes = b"") -> Answer:
        """Ask, and wait for the answer.

        :raises LineError: if the courier is gone.
        """
        self.tell(kind, place, first, second, payload)
        self.send()
        size, dropped, value = ANSWER.unpack(receive(self._socket, ANSWER.size))
        return Answer(value, dropped, receive(self._socket, size) if size else b"")

    def fileno(self) -> int:
        """The descriptor of the socket, past what is told and not sent."""
        return self._socket.fileno()

    def close(self) -> None:
        """Hang up: there is nothing more to say."""
        self.send()
        self._socket.close()


class CourierLine:
    """The courier's end."""

    def __init__(self, end: socket.socket) -> None:
        self._socket = end
        self._heard = b""

    def hear(self) -> Frame | None:
        """What the node says next; None once it has hung up or died, be it in the middle of a frame.

        :raises LineError: if that is nonsense.
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
        """So many bytes; as many as there are are fetched at a time."""
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
        """Answer what the node asked; in vain if it is dead."""
        try:
            self._socket.sendall(ANSWER.pack(len(body), dropped, value) + body)
        except OSError:
            return  # hear() will tell


def question(key: str, payload: bytes, timeout_s: float) -> bytes:
    """A frame that asks whoever answers for ``key`` on the bus; the answer's value counts the replies."""
    asked = key.encode() + b"\0" + payload
    return _FRAME.pack(ASK, 0, len(asked), round(timeout_s * 1e9), 0) + asked


class NonsenseError(LineError):
    """What a node says makes no sense."""


class HungUpError(LineError):
    """The other end was closed."""


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
