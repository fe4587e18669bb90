"""The processes of a mission on two hosts: the simulator here, the stages on a companion computer.

There its own supervisor starts and watches them (:mod:`deploy.workers.companion`); what it reports is kept
here in the same form as of processes of this host, so that a mission is flown alike. Messages go over the
routers of both hosts' stacks. Nothing of that has a part in virtual time.
"""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import zenoh
from zenoh.handlers import Callback

from deploy.config.processes import ProcessDeclaration
from deploy.errors import BadSpecError, DisturbedFlightError, InfrastructureError
from deploy.mission.companion_orders import (
    ALL_STACKS,
    FLIGHTS,
    ORDERS,
    CompanionFailure,
    CompanionOrder,
    CompanionReport,
    FlightTerms,
)
from deploy.mission.fork_server import Exited
from deploy.mission.supervisor import SupervisedNode, Supervisor
from services.bus.session import BusAddress, open_visitor
from services.models.pilots import numbered
from services.runtime.setup import NodeSetup
from services.system.shared_stats import SharedStats

ORDER_S = 60.0
"""Longest wait for the answer to an order: a companion computer that is busy is not lost."""

FOUND_S = 10.0
"""Longest wait until a companion computer is found: routers that have just started do not know each other."""

LONG_S = 86_400.0
"""For answers that come when something happens; the end of the companion ends the wait, too."""

Told = CompanionReport | CompanionFailure | None
"""What an order is answered by; None if whoever took it is gone."""


class Companion:
    """A companion computer, found by its host's name over the router of this host's stack."""

    def __init__(self, host: str, stack: BusAddress) -> None:
        """Find the companion computer of a host, which may just have started.

        :raises BadSpecError: if none is there, or more than one.
        """
        self.host = host
        self.bus_settings: Mapping[str, object] = {"connect/endpoints": [stack.endpoint("router")]}
        """What the router of a mission's own sessions needs to reach it."""
        try:
            self._session = open_visitor(BusAddress(stack.folder, ALL_STACKS))
        except zenoh.ZError as error:
            message = f"--companion: no stack is up in {stack.folder}: zenfi up"
            raise BadSpecError(message) from error
        self._place, hello = self._found(host)
        self.fixed_pids = hello.fixed_pids
        self.installation = hello.installation
        """What is installed there, as :func:`deploy.workers.installation.told` tells it."""

    def _found(self, host: str) -> tuple[str, CompanionReport]:
        order = CompanionOrder(do="hello").model_dump_json()
        deadline = time.monotonic() + FOUND_S
        found: dict[str, CompanionReport] = {}
        while not found and time.monotonic() < deadline:
            for reply in self._session.get(f"{host}/*/{ORDERS}", payload=order, timeout=ORDER_S):
                if reply.ok is not None:
                    place = str(reply.ok.key_expr).removesuffix(f"/{ORDERS}")
                    found[place] = CompanionReport.model_validate_json(reply.ok.payload.to_bytes())
            time.sleep(0.0 if found else 0.1)
        if len(found) != 1:
            self.close()
            what = (
                f"several: {', '.join(sorted(found))}" if found else "none that this host's stack can reach"
            )
            message = f"--companion: on {host} there is {what}; zenfi companion is to run in one stack there"
            raise BadSpecError(message)
        return found.popitem()

    @contextmanager
    def flight(self, token: str) -> Iterator[None]:
        """Announce a mission: what the companion computer starts for it ends with this."""
        declared = self._session.liveliness().declare_token(f"{self._place}/{FLIGHTS}/{token}")
        try:
            yield
        finally:
            declared.undeclare()  # type: ignore[no-untyped-call]

    def order(self, order: CompanionOrder) -> CompanionReport:
        """Give an order and wait for its report.

        :raises BadSpecError: if it is refused.
        :raises DisturbedFlightError: if a process there was ended from outside.
        :raises InfrastructureError: if it fails, or the companion computer does not answer.
        """
        answers: queue.SimpleQueue[Told] = queue.SimpleQueue()
        self.send(order, answers.put, ORDER_S)
        return self.checked(answers.get())

    def send(self, order: CompanionOrder, told: Callable[[Told], None], timeout_s: float = LONG_S) -> None:
        """Give an order; ``told`` is called once, on a thread of Zenoh's, with what it is answered by."""
        answers: list[Told] = []

        def take(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                answers.append(CompanionReport.model_validate_json(reply.ok.payload.to_bytes()))
            elif reply.err is not None:
                with suppress(ValueError):  # Zenoh's own word for a time that is over
                    answers.append(CompanionFailure.model_validate_json(reply.err.payload.to_bytes()))

        self._session.get(
            f"{self._place}/{ORDERS}",
            Callback(take, lambda: told(answers[0] if answers else None), indirect=False),
            payload=order.model_dump_json(),
            timeout=timeout_s,
        )

    def checked(self, told: Told) -> CompanionReport:
        """The report of an answer that is one.

        :raises BadSpecError, DisturbedFlightError, InfrastructureError: as :meth:`order` does.
        """
        if isinstance(told, CompanionReport):
            return told
        if told is None:
            message = f"the companion computer {self.host} is lost or does not answer"
            raise InfrastructureError(message)
        text = f"companion computer {self.host}: {told.text}"
        kinds = {"refused": BadSpecError, "disturbed": DisturbedFlightError, "failed": InfrastructureError}
        raise kinds[told.kind](text)

    def close(self) -> None:
        """Close the session; missions of this process that are under way there end."""
        self._session.close()  # type: ignore[no-untyped-call]


class TwoHostProcesses:
    """The processes of one mission, on this host and on a companion computer."""

    def __init__(self, here: Supervisor, companion: Companion, folder: Path) -> None:
        self._here, self._companion, self._folder = here, companion, folder
        self._far: dict[str, SupervisedNode] = {}
        self._news: queue.SimpleQueue[Told] = queue.SimpleQueue()
        self._number = -1

    @classmethod
    @contextmanager
    def opened(
        cls, here: Supervisor, companion: Companion, terms: FlightTerms, folder: Path
    ) -> Iterator[TwoHostProcesses]:
        """The processes of a mission, of which none is started yet; ``folder`` is the mission's here.

        :raises BadSpecError, InfrastructureError: if the companion computer does not take it.
        """
        with companion.flight(terms.token):
            companion.order(CompanionOrder(do="open", terms=terms))
            with closing(cls(here, companion, folder)) as processes:
                processes.await_news()
                yield processes

    @property
    def members(self) -> Mapping[str, SupervisedNode]:
        """The processes of both hosts by name."""
        return {**self._here.members, **self._far}

    def start(self, process: ProcessDeclaration, setup: NodeSetup) -> SupervisedNode:
        """Start a process where it belongs, for the first time or again."""
        if process.host == "simulator":
            return self._here.start(process, setup)
        if process.name not in self._far:
            log = self._folder / f"{process.name}.log"
            guards = numbered(setup.spec.active_guards)
            member = SupervisedNode(process, SharedStats.create(process.name), log, setup.kernels, guards)
            self._far[process.name] = member
        self._take(self._companion.order(CompanionOrder(do="start", setup=setup)))
        return self._far[process.name]

    def await_news(self) -> None:
        """Ask to be told when a process there has ended."""
        self._companion.send(CompanionOrder(do="await"), self._news.put)

    def deaths(self) -> list[tuple[SupervisedNode, Exited]]:
        """The members that ended since the last call, as :meth:`Supervisor.deaths` gives them.

        :raises InfrastructureError: also if the companion computer is lost.
        """
        ended = self._here.deaths()
        while not self._news.empty():
            report = self._companion.checked(self._news.get())
            self._take(report)
            for one in report.ended:
                member = self._far[one.name]
                ended.append((member, Exited(member.pid, one.status, one.by_another)))
            self.await_news()
        return ended

    def _take(self, report: CompanionReport) -> None:
        """Note how the processes there are, unless something newer is known."""
        if report.number < self._number:
            return
        self._number = report.number
        for name, told in report.processes.items():
            member = self._far[name]
            member.pid, member.life, member.alive = told.pid, told.life, told.alive
            member.crashes, member.hangs, member.causes = told.crashes, told.hangs, told.causes
            member.log.write_text(told.log_tail)
            member.stats.replace(bytes.fromhex(told.page))

    def refresh(self) -> list[str]:
        """Have the counters of all members be what they are now; the names of those that somebody stopped."""
        report = self._companion.order(CompanionOrder(do="look"))
        self._take(report)
        return self._here.refresh() + report.stopped

    def pids(self) -> list[int]:
        """The processes of the mission that are alive on this host; those of the companion are not seen."""
        return self._here.pids()

    def cpu_s(self) -> float:
        """Processor time of the nodes on this host."""
        return self._here.cpu_s()

    def kill_hung(self) -> None:
        """Kill the nodes here that have used more thread time than a hang is granted, as is done there."""
        self._here.kill_hung()

    def kill_as_hung(self, member: SupervisedNode) -> None:
        """Kill a node; its end will be counted as a hang."""
        name = member.process.name
        if name in self._far:
            self._companion.order(CompanionOrder(do="kill", name=name))
        else:
            self._here.kill_as_hung(member)

    def end(self, grace_s: float, meanwhile: Callable[[], object]) -> None:
        """Wait for the members to end by themselves, calling ``meanwhile`` again and again; kill the rest."""
        answers: queue.SimpleQueue[Told] = queue.SimpleQueue()
        self._companion.send(CompanionOrder(do="end", grace_s=grace_s), answers.put)
        self._here.end(grace_s, meanwhile)
        while answers.empty():
            meanwhile()
        self._take(self._companion.checked(answers.get()))

    def close(self) -> None:
        """Kill all processes that are left there and free the pages; those here are their supervisor's."""
        with suppress(InfrastructureError, BadSpecError):  # it is lost, and they with it
            self._companion.order(CompanionOrder(do="close"))
        for member in self._far.values():
            member.stats.close()
