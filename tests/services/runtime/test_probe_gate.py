"""Probes leave no trace in the node that sends them: a replay, which sends none, finds its memory alike."""

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

from services.bus.proxy_link import ANSWER, LinkError, NodeLink, ProxyLink, question
from services.runtime.probe_gate import PROBE, stand_at_gate, warm_up
from services.system.lifeline import die_with_parent
from services.system.process_stat import process_stat
from tests.conftest import alive, descendants, wait_until
from tests.process_memory import Memory, different, memory

QUESTION = question("gate", b"may I?", 1.0)
GONE = ANSWER.pack(0, 0, 0)


def be_a_node(descriptor: int, *, probes_stay: bool = False) -> None:
    """Pass the gate again and again, and stand still behind it."""
    die_with_parent()
    gc.disable()  # as a node does
    warm_up()
    line = NodeLink(socket.socket(fileno=descriptor))
    while not stand_at_gate(line, QUESTION):
        signal.raise_signal(signal.SIGSTOP)
    while probes_stay:
        signal.pause()
    os._exit(0)


def start_node(end: socket.socket, *, probes_stay: bool = False) -> "subprocess.Popen[bytes]":
    program = f"from {__name__} import be_a_node; be_a_node({end.fileno()}, {probes_stay=})"
    return subprocess.Popen(
        [sys.executable, "-c", program],
        pass_fds=[end.fileno()],
        cwd=Path(__file__).parents[3],
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},  # a node has one thread
    )


@contextmanager
def node_at_the_gate(learning: int) -> Iterator[Callable[[Sequence[bytes]], Memory]]:
    """Lets a node pass the gate by the answers that are given; its heap behind the gate.

    Before, it passes it so often that the interpreter has learnt what it runs.
    """
    proxy, end = socket.socketpair()
    node = start_node(end)
    # The kernel tells a thread in its memory on which processor it runs (rseq(2)): always on the same.
    os.sched_setaffinity(node.pid, {min(os.sched_getaffinity(0))})
    told = ProxyLink(proxy)

    def answer(answers: Sequence[bytes]) -> None:
        for one in answers:
            assert told.hear() is not None
            told.answer(1, 0, one)
        assert os.WIFSTOPPED(os.waitpid(node.pid, os.WUNTRACED)[1])

    def let_pass(answers: Sequence[bytes]) -> Memory:
        answer(answers)
        found = memory(node.pid, stack=False)
        node.send_signal(signal.SIGCONT)
        return found

    with proxy, end, node:
        try:
            for _ in range(learning):
                answer([b"open"])
                node.send_signal(signal.SIGCONT)
            yield let_pass
        finally:
            node.kill()


@pytest.mark.soak
def test_a_node_is_the_same_whether_it_has_sent_probes_or_not() -> None:
    with node_at_the_gate(learning=100) as let_pass:
        # What passing alone writes: objects come and go, each time in another of a few places.
        heaps = [let_pass([b"open"]) for _ in range(24)]
        usual = set.union(*(different(before, after) for before, after in pairwise(heaps)))
        assert different(heaps[-1], let_pass([*[PROBE] * 20, b"open"])) <= usual


def test_a_probe_is_told_that_it_is_one() -> None:
    proxy, end = socket.socketpair()
    with proxy, end:
        reads, says = os.pipe()
        node = os.fork()
        if not node:
            die_with_parent()
            os.write(says, b"probe" if stand_at_gate(NodeLink(end), QUESTION) else b"node")
            os._exit(0)
        told = ProxyLink(proxy)
        heard = [told.hear()]
        told.answer(1, 0, PROBE)
        assert os.read(reads, 16) == b"probe"
        heard.append(told.hear())
        told.answer(1)
        assert os.read(reads, 16) == b"node"
        assert os.waitpid(node, 0)[1] == 0
        os.close(reads)
        os.close(says)
    assert [one is not None and one.payload for one in heard] == [b"gate\0may I?"] * 2


def test_a_probe_dies_with_its_node() -> None:
    proxy, end = socket.socketpair()
    with proxy, end, start_node(end, probes_stay=True) as node:
        told = ProxyLink(proxy)
        assert told.hear() is not None
        told.answer(1, 0, PROBE)
        wait_until(lambda: bool(descendants(node.pid)))
        (probe,) = descendants(node.pid)
        wait_until(lambda: process_stat(probe).state == "S")  # it stays, by itself
        node.kill()
        wait_until(lambda: not alive(probe))


@pytest.mark.parametrize(("answer", "what"), [(GONE, "nobody answers"), (b"", "the proxy is gone")])
def test_a_gate_at_which_nobody_is_opens_for_nobody(answer: bytes, what: str) -> None:
    proxy, end = socket.socketpair()
    with end:
        proxy.sendall(answer)
        proxy.shutdown(socket.SHUT_WR)
        with pytest.raises(LinkError, match=what):
            stand_at_gate(NodeLink(end), QUESTION)
        proxy.close()
