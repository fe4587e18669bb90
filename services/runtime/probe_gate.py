"""Probes: copies of a node that run an armed call ahead of it, to profile the call before the injection.

A probe is a fork of the node at the gate. It has the node's memory and only its main thread, runs the
same call in view of the injector and ends with it; it never reaches the session. A replay sends no probes and
is to find the node's memory alike, so all of this is compiled (:mod:`services.system.c_library`).
"""

from __future__ import annotations

import errno
import os
import socket

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.bus.proxy_link import ANSWER, LinkError, NodeLink
from services.system import c_library
from services.system.process_copies import fork_and_wait

PROBE = b"probe"
"""The injector's answer at the gate that asks for a probe, after which the node asks again."""

_OPEN, _IN_PROBE = 0, 1
_UNANSWERED, _GONE = -1000, -1001

_LONGEST = 256
"""Bytes of an answer at the gate."""

_EINTR = errno.EINTR
_MSG_NOSIGNAL, _MSG_WAITALL = int(socket.MSG_NOSIGNAL), int(socket.MSG_WAITALL)


def stand_at_gate(line: NodeLink, question: bytes) -> bool:
    """Ask at the gate (:func:`services.bus.proxy_link.question`) until it opens; True in a probe sent ahead.

    :raises LinkError: if nobody answers in time, or the proxy is gone.
    :raises OSError: if there can be no probe.
    """
    asked, probe = (np.frombuffer(text, np.uint8).copy() for text in (question, PROBE))
    answer = _stand_at_gate(line.fileno(), asked, np.zeros(ANSWER.size + _LONGEST, np.uint8), probe)
    if answer == _UNANSWERED:
        raise LinkError("nobody answers")
    if answer == _GONE:
        raise LinkError("the proxy is gone")
    if answer < 0:
        raise OSError(-answer, os.strerror(-answer))
    return bool(answer == _IN_PROBE)


def warm_up() -> None:
    """Compile the loop at the gate before there is a flight."""
    proxy, node = socket.socketpair()
    with proxy, node:
        proxy.send(ANSWER.pack(0, 0, 1))
        stand_at_gate(NodeLink(node), b"?")


@njit(cache=True)
def _stand_at_gate(
    line: int, question: NDArray[np.uint8], answer: NDArray[np.uint8], probe: NDArray[np.uint8]
) -> int:
    """``_OPEN``, ``_IN_PROBE``, ``_UNANSWERED``, ``_GONE`` or an error's negative number."""
    head = len(answer) - _LONGEST
    while True:
        if c_library.send(line, question.ctypes.data, len(question), _MSG_NOSIGNAL) != len(question):
            return _GONE
        if not _receive(line, answer[:head]):
            return _GONE
        size, replies = answer[:4].view(np.uint32)[0], answer[8:head].view(np.int64)[0]
        if not replies:
            return _UNANSWERED
        text = answer[head : head + size]
        if len(text) != size or not _receive(line, text):
            return _GONE
        if not _same(text, probe):
            return _OPEN
        text[:] = 0  # in a replay there was no such answer
        forked = fork_and_wait()
        if forked:
            return forked


@njit(cache=True)
def _receive(line: int, buffer: NDArray[np.uint8]) -> bool:
    """Fill the buffer; False if the other end is gone."""
    got = 0
    while got < len(buffer):
        more = c_library.recv(line, buffer.ctypes.data + got, len(buffer) - got, _MSG_WAITALL)
        if more < 0 and c_library.error() == _EINTR:
            continue
        if more <= 0:
            return False
        got += more
    return True


@njit(cache=True)
def _same(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> bool:
    """As ``np.array_equal``, which makes an array."""
    if len(one) != len(other):
        return False
    for place in range(len(one)):  # noqa: SIM110 - numba has no all()
        if one[place] != other[place]:
            return False
    return True
