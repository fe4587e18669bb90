"""Scouts leave no trace in the node that sends them: a replay, which sends none, finds its memory alike."""

import gc
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import pytest

from services.bus.lifeline import die_with_parent
from services.bus.line import ANSWER, CourierLine, Line, LineError, question
from services.bus.process_stat import process_stat
from services.bus.scout import SCOUT, stand_at_gate, warm_up
from tests.conftest import alive, descendants, wait_until
from tests.process_memory import Memory, different, memory

QUESTION = question("gate", b"may I?", 1.0)
GONE = ANSWER.pack(0, 0, 0)


def be_a_node(descriptor: int, *, scouts_stay: bool = False) -> None:
    """Pass the gate again and again, and stand still behind it."""
    die_with_parent()
    gc.disable()  # as a node does
    warm_up()
    line = Line(socket.socket(fileno=descriptor))
    while not stand_at_gate(line, QUESTION):
        signal.raise_signal(signal.SIGSTOP)
    while scouts_stay:
        signal.pause()
    os._exit(0)


def start_node(end: socket.socket, *, scouts_stay: bool = False) -> "subprocess.Popen[bytes]":
    program = f"from {__name__} import be_a_node; be_a_node({end.fileno()}, {scouts_stay=})"
    return subprocess.Popen(
        [sys.executable, "-c", program],
        pass_fds=[end.fileno()],
        cwd=Path(__file__).parents[3],
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},  # a node has one thread
    )


@contextmanager
def node_at_the_gate() -> Iterator[Callable[[Sequence[bytes]], Memory]]:
    """Lets a node pass the gate by the answers that are given; its heap behind the gate."""
    courier, end = socket.socketpair()
    node = start_node(end)
    told = CourierLine(courier)

    def let_pass(answers: Sequence[bytes]) -> Memory:
        for answer in answers:
            assert told.hear() is not None
            told.answer(1, 0, answer)
        assert os.WIFSTOPPED(os.waitpid(node.pid, os.WUNTRACED)[1])
        found = memory(node.pid, stack=False)
        node.send_signal(signal.SIGCONT)
        return found

    with courier, end, node:
        try:
            yield let_pass
        finally:
            node.kill()


def test_a_node_is_the_same_whether_it_has_sent_scouts_or_not() -> None:
    with node_at_the_gate() as let_pass:
        for _ in range(100):  # until the interpreter has learnt what it runs
            let_pass([b"open"])
        # What passing alone writes: objects come and go, each time in another of a few places.
        heaps = [let_pass([b"open"]) for _ in range(24)]
        usual = set.union(*(different(before, after) for before, after in pairwise(heaps)))
        assert different(heaps[-1], let_pass([*[SCOUT] * 20, b"open"])) <= usual


def test_a_scout_is_told_that_it_is_one() -> None:
    courier, end = socket.socketpair()
    with courier, end:
        reads, says = os.pipe()
        node = os.fork()
        if not node:
            die_with_parent()
            os.write(says, b"scout" if stand_at_gate(Line(end), QUESTION) else b"node")
            os._exit(0)
        told = CourierLine(courier)
        heard = [told.hear()]
        told.answer(1, 0, SCOUT)
        assert os.read(reads, 16) == b"scout"
        heard.append(told.hear())
        told.answer(1)
        assert os.read(reads, 16) == b"node"
        assert os.waitpid(node, 0)[1] == 0
        os.close(reads)
        os.close(says)
    assert [one is not None and one.payload for one in heard] == [b"gate\0may I?"] * 2


def test_a_scout_dies_with_its_node() -> None:
    courier, end = socket.socketpair()
    with courier, end, start_node(end, scouts_stay=True) as node:
        told = CourierLine(courier)
        assert told.hear() is not None
        told.answer(1, 0, SCOUT)
        wait_until(lambda: bool(descendants(node.pid)))
        (scout,) = descendants(node.pid)
        wait_until(lambda: process_stat(scout).state == "S")  # it stays, by itself
        node.kill()
        wait_until(lambda: not alive(scout))


@pytest.mark.parametrize(("answer", "what"), [(GONE, "nobody answers"), (b"", "the courier is gone")])
def test_a_gate_at_which_nobody_is_opens_for_nobody(answer: bytes, what: str) -> None:
    courier, end = socket.socketpair()
    with end:
        courier.sendall(answer)
        courier.shutdown(socket.SHUT_WR)
        with pytest.raises(LineError, match=what):
            stand_at_gate(Line(end), QUESTION)
        courier.close()
