"""An executable's part in a mission: it is given what its stage may see, and what it answers is published."""

from __future__ import annotations

import json
import os
import signal
import sys

import numpy as np

from services.bus.horizon import Stamped
from services.bus.messages import MalformedMessageError, decode
from services.bus.proxy_link import LinkError, NodeLink
from services.bus.topics import TOPICS, published_by
from services.foreign.program import (
    ProgramDiedError,
    ProgramError,
    ProgramOutput,
    StageProgram,
    greeting,
    step,
)
from services.models.own_stack import OwnStage, trigger
from services.runtime.kernel_timer import GATE_TIMEOUT_S, KernelTimer
from services.runtime.node import Node
from services.runtime.probe_gate import PROBE
from services.runtime.setup import NodeSetup
from services.system.process_stat import listed_pid
from services.system.shared_stats import SharedStats
from services.system.stopwatch import KernelStopwatch

_OURS = (70, 71)
"""Exit statuses that mean something else where a node ends with them."""


def main(setup: NodeSetup, proxy: NodeLink, stats: SharedStats, tracer_pid: int) -> None:
    """Hand the executable what it may see, step by step, until no trigger can follow."""
    own = setup.spec.own_stage(setup.name)
    assert own is not None  # noqa: S101 - that is why we run
    try:
        with ForeignNode(setup, proxy, stats, own, tracer_pid) as node:
            inputs = [node.input(name) for name in (trigger(setup.name), *own.inputs)]
            node.ready()
            for message in node.spin(inputs[0]):
                seen = [(one.topic.name, new) for one in inputs[1:] for new in one.new]
                node.look([*seen, (inputs[0].topic.name, message)])
                with node.kernel(setup.name):
                    made = node.compute()
                for one in made:
                    node.publish(one)
        node.dismiss()
    except ProgramDiedError as died:
        _die_alike(died.status)


class ForeignNode(Node):
    """A node whose kernel is a program."""

    def __init__(
        self, setup: NodeSetup, proxy: NodeLink, stats: SharedStats, own: OwnStage, tracer_pid: int
    ) -> None:
        super().__init__(setup, proxy, stats, _ProgramTimer(setup, proxy, stats, self))
        fault = setup.spec.fault
        self._own, self._tracer_pid = own, tracer_pid
        self._struck = fault is not None and fault.level == "instruction" and fault.target == setup.name
        mission = setup.spec.model_copy(update={"fault": None}).model_dump_json().encode()
        self._told = [greeting(setup.name, setup.life, mission)]
        self._now = b""
        self._program = self._begun()
        try:
            self._program.await_ready()
        except ProgramDiedError as error:
            message = f"{self.name}: the program ended with status {error.status} before it was ready"
            raise ProgramError(message) from error
        self._page["program"] = listed_pid(self._program.pid)

    def ready(self, *watched: str) -> None:
        """Announce the program, and wait until every node of the mission is announced."""
        inputs = list(self._inputs)
        self._declare({"inputs": inputs, "watched": watched, "program": listed_pid(self._program.pid)})

    def look(self, messages: list[tuple[str, Stamped]]) -> None:
        """Keep the messages that the next step may see."""
        self._now = step(messages, self.now_ns)

    def compute(self) -> list[ProgramOutput]:
        """Let the program compute its step; return what it publishes."""
        self._program.tell(self._now)
        if self._struck:
            self._told.append(self._now)
        return self._program.answer()

    def publish(self, made: ProgramOutput) -> None:
        """Publish what the program has made.

        :raises ProgramError: if it is no message of a topic of the stage.
        """
        topics = [topic.name for topic in published_by(self.name)]
        if made.topic not in topics:
            message = f"{self.name} publishes {', '.join(topics)}, not {made.topic!r}"
            raise ProgramError(message)
        try:
            self.put(made.topic, decode(made.payload, TOPICS[made.topic].type))
        except MalformedMessageError as error:
            message = f"{made.topic}: {error}"
            raise ProgramError(message) from error

    def dismiss(self) -> None:
        """Let the program end: the mission is over."""
        self._program.dismiss()
        self._program.kill()

    def _begun(self) -> StageProgram:
        program = StageProgram(self._own, self._tracer_pid)
        program.tell(self._told[0])
        return program

    def send_probe(self, key: str) -> None:
        """Have another process of the program go through the call in view of the injector.

        It gets all the input that the program got, so it is in the same state.
        """
        probe = self._begun()
        try:
            probe.await_ready()
            for told in self._told[1:]:
                probe.tell(told)
                probe.answer()
            request = json.dumps({"phase": "probe", "pid": listed_pid(probe.pid)})
            self.ask(key, request, GATE_TIMEOUT_S)
            probe.tell(self._now)
            probe.answer()
        except (ProgramDiedError, ProgramError):
            pass  # the injector has seen enough
        finally:
            probe.kill()

    @property
    def cpu_ns(self) -> int:
        """Processor time that the program has used."""
        return self._program.cpu_ns


class _ProgramTimer(KernelTimer):
    """Times the program instead of the node, and sends probes of the program."""

    def __init__(self, setup: NodeSetup, proxy: NodeLink, stats: SharedStats, node: ForeignNode) -> None:
        super().__init__(setup, proxy, stats.page, _ProgramStopwatch(stats.page, node))
        self._node = node

    def _stand_at_gate(self, key: str, request: str) -> bool:
        """Ask at the gate until it opens; the probes that are sent ahead are programs, none of us."""
        while (answer := self._node.ask(key, request, GATE_TIMEOUT_S)) == PROBE:
            self._node.send_probe(key)
        if answer is None:
            raise LinkError("nobody answers at the gate")
        return False


class _ProgramStopwatch(KernelStopwatch):
    """Processor time of the program that computes, all its threads."""

    def __init__(self, page: np.void, node: ForeignNode) -> None:
        self._node = node
        super().__init__(page, 0)

    def _read(self) -> None:
        self._now[:] = 0, self._node.cpu_ns


def _die_alike(status: int) -> None:
    """End this process as the program ended: with its status, or by its signal."""
    if status < 0:
        signal.signal(-status, signal.SIG_DFL) if -status != signal.SIGKILL else None
        os.kill(os.getpid(), -status)
    sys.stderr.flush()
    os._exit(1 if status in _OURS else status)
