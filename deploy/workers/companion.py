"""The companion computer: runs the stages of missions whose simulator is on another host.

It is a process of a stack (``zenfi companion``) and takes orders over the stack's router, which lets in who
has a host's certificate. One mission at a time; its processes end with it, with this process, and as
soon as the mission's host is no longer there.
"""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, Literal

import zenoh
from pydantic import ValidationError

from deploy.config.workdir import mission_folder
from deploy.errors import BadSpecError, DisturbedFlightError, InfrastructureError
from deploy.mission.companion_orders import (
    FLIGHTS,
    ORDERS,
    CompanionFailure,
    CompanionOrder,
    CompanionReport,
    EndReport,
    FlightTerms,
    ProcessReport,
)
from deploy.mission.fork_server import ForkServer, ForkServerError
from deploy.mission.restarts import POLL_S
from deploy.mission.supervisor import SupervisedNode, Supervisor
from deploy.workers import installation
from services.bus import announce
from services.bus.session import BusAddress, hand_over, open_visitor
from services.models.base import first_problem
from services.runtime.setup import NodeSetup

NAME = "companion"
"""Under which it is announced in its stack once it takes orders."""

TOKEN_S = 10.0
"""Longest wait for the token of a mission that is to begin."""

_PAUSE_S = 0.001


def serve(stack: BusAddress) -> None:
    """Take orders from other hosts over the router of a stack, until this process is ended.

    :raises InfrastructureError: if the fork server is lost; a stack then starts another companion.
    """
    with closing(ForkServer()) as server, closing(open_visitor(stack)) as bus:
        companion = CompanionComputer(bus, server, stack)
        try:
            while not server.is_lost():
                companion.take_in(POLL_S)
            raise InfrastructureError("the fork server was lost")
        finally:
            companion.close()


class StageProcesses:
    """The processes of one mission that run here."""

    def __init__(self, server: ForkServer, stack: BusAddress, terms: FlightTerms) -> None:
        self.terms = terms
        self._server = server
        with ExitStack() as held:
            folder = held.enter_context(mission_folder())
            address = BusAddress(folder, terms.namespace)
            # They meet at the router of the stack, which knows the way to the other host.
            (folder / "router.sock").symlink_to(Path(stack.endpoint("router").partition("/")[2]))
            self.supervisor = Supervisor(
                server, address, terms.hang_cpu_s, traced=terms.traced, armed=terms.armed
            )
            held.callback(self.supervisor.close)
            self._held = held.pop_all()
        self.waiting: zenoh.Query | None = None
        self._number = 0
        self._ended: list[EndReport] = []

    def start(self, setup: NodeSetup) -> None:
        """Start a process, for the first time or again.

        :raises BadSpecError: if it is none that may run here.
        """
        process = self._server.stack.get(setup.name)
        if process is None or process.host != "companion":
            message = f"{setup.name} is no process of a companion computer"
            raise BadSpecError(message)
        if setup.spec.stack is not None:
            raise BadSpecError("programs of one's own in the place of stages are not run for other hosts")
        if setup.clock is not None:
            raise BadSpecError("a flight in real time has a clock that all processes share: use lockstep")
        self.supervisor.start(process, setup)

    def kill(self, name: str) -> None:
        """Kill a process; its end will be counted as a hang.

        :raises BadSpecError: if it was never started.
        """
        if name not in self.supervisor.members:
            message = f"{name} was not started here"
            raise BadSpecError(message)
        self.supervisor.kill_as_hung(self.supervisor.members[name])

    def watch(self) -> None:
        """Notice who has ended or hangs.

        :raises DisturbedFlightError, InfrastructureError: as :meth:`Supervisor.deaths` does.
        """
        for member, exited in self.supervisor.deaths():
            self._ended.append(
                EndReport(name=member.process.name, status=exited.status, by_another=exited.by_another)
            )
        self.supervisor.kill_hung()

    @property
    def has_news(self) -> bool:
        """Whether a process has ended of which nobody was told yet."""
        return bool(self._ended)

    def report(self, *, with_ended: bool = False) -> CompanionReport:
        """How all are now, and if asked who has ended since that was told last."""
        self._number += 1
        ended = self._ended if with_ended else []
        if with_ended:
            self._ended = []
        return CompanionReport(
            number=self._number,
            processes={name: _told(member) for name, member in self.supervisor.members.items()},
            ended=ended,
            stopped=self.supervisor.refresh(),
        )

    def close(self) -> None:
        """Kill what is left and remove the folder."""
        self._held.close()


def _told(member: SupervisedNode) -> ProcessReport:
    return ProcessReport(
        pid=member.pid,
        life=member.life,
        alive=member.alive,
        crashes=member.crashes,
        hangs=member.hangs,
        causes=member.causes,
        log_tail=member.log_tail,
        page=member.stats.content().hex(),
    )


class CompanionComputer:
    """Takes orders in one thread, one after the other; Zenoh's threads only queue them."""

    def __init__(self, bus: zenoh.Session, server: ForkServer, stack: BusAddress) -> None:
        self._bus, self._server, self._stack = bus, server, stack
        self._flight: StageProcesses | None = None
        self._events: queue.SimpleQueue[tuple[Callable[[Any], None], Any]] = queue.SimpleQueue()
        self._declared: list[Any] = [
            bus.declare_queryable(ORDERS, hand_over(lambda one: self._events.put((self._answer, one)))),
            bus.liveliness().declare_subscriber(
                f"{FLIGHTS}/*", hand_over(lambda one: self._events.put((self._meet, one)))
            ),
            bus.liveliness().declare_token(announce.announcement(NAME).key),
        ]

    def take_in(self, timeout_s: float) -> None:
        """Handle what has arrived, waiting for it up to ``timeout_s``; look after the processes."""
        try:
            handle, event = self._events.get(timeout=timeout_s)
        except queue.Empty:
            pass
        else:
            handle(event)
        if self._flight is not None:
            self._watch(self._flight)

    def _watch(self, flight: StageProcesses) -> None:
        if flight.waiting is None:
            return  # nobody would be told
        try:
            flight.watch()
        except InfrastructureError as error:
            query, flight.waiting = flight.waiting, None
            _fail(query, error)
        else:
            if flight.has_news:
                query, flight.waiting = flight.waiting, None
                _reply(query, flight.report(with_ended=True))

    def _meet(self, token: zenoh.Sample) -> None:
        """End the processes of a mission whose host has left."""
        name = str(token.key_expr).rpartition("/")[2]
        gone = token.kind == zenoh.SampleKind.DELETE
        if gone and self._flight is not None and self._flight.terms.token == name:
            self.close()

    def _answer(self, query: zenoh.Query) -> None:
        try:
            payload = query.payload.to_bytes() if query.payload is not None else b""
            report = self._do(CompanionOrder.model_validate_json(payload), query)
        except ValidationError as error:
            _fail(query, BadSpecError(first_problem(error)))
        except (BadSpecError, InfrastructureError, ForkServerError) as error:
            _fail(query, error)
        else:
            if report is not None:
                _reply(query, report)

    def _do(self, order: CompanionOrder, query: zenoh.Query) -> CompanionReport | None:
        """Carry out an order; None if it is answered later."""
        if order.do == "hello":
            return CompanionReport(installation=installation.told(), fixed_pids=self._server.fixed_pids)
        if order.do == "open" and order.terms is not None:
            self._open(order.terms)
            return CompanionReport()
        flight = self._flight
        if flight is None:
            raise InfrastructureError("no flight is under way")
        if order.do == "await":
            flight.waiting = query
            return None
        if order.do == "start" and order.setup is not None:
            flight.start(order.setup)
        elif order.do == "kill":
            flight.kill(order.name)
        elif order.do == "end":
            flight.supervisor.end(order.grace_s, lambda: time.sleep(_PAUSE_S))
        elif order.do == "close":
            self.close()
            return CompanionReport()
        return flight.report()

    def _open(self, terms: FlightTerms) -> None:
        if self._flight is not None:
            raise InfrastructureError("another mission is under way here: one at a time")
        deadline = time.monotonic() + TOKEN_S
        while not self._announced(terms.token):
            if time.monotonic() > deadline:
                raise InfrastructureError("the mission is not announced: nobody would know of its end")
            time.sleep(_PAUSE_S)
        self._flight = StageProcesses(self._server, self._stack, terms)

    def _announced(self, token: str) -> bool:
        """Whether a mission is; its token may come later over the routers than its first order."""
        found = self._bus.liveliness().get(f"{FLIGHTS}/{token}", timeout=TOKEN_S)
        return any(reply.ok is not None for reply in found)

    def close(self) -> None:
        """End the mission that is under way, if there is one."""
        flight, self._flight = self._flight, None
        if flight is not None:
            if flight.waiting is not None:
                flight.waiting.drop()  # type: ignore[no-untyped-call]
            flight.close()


def _reply(query: zenoh.Query, report: CompanionReport) -> None:
    with query:
        query.reply(ORDERS, report.model_dump_json())


def _fail(query: zenoh.Query, error: Exception) -> None:
    kind: Literal["refused", "disturbed", "failed"] = "failed"
    if isinstance(error, BadSpecError):
        kind = "refused"
    elif isinstance(error, DisturbedFlightError):
        kind = "disturbed"
    with query:
        query.reply_err(CompanionFailure(kind=kind, text=str(error)).model_dump_json())
