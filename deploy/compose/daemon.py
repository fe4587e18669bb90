"""The supervisor of a stack: lets what is declared be what runs (``docs/supervisor.md``).

One thread, one loop. Events go into :class:`StackStates`, the actions that come out are carried out by
:class:`Lives`; every change is journalled and told on Zenoh.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from deploy.compose.bus import StackBus, host, namespace
from deploy.compose.control import RefusedError, Request
from deploy.compose.events import Again, Ask, Declare, Event, Kill, Launch, Passed, Unwant, Want
from deploy.compose.family import become_subreaper, clear_marked
from deploy.compose.folder import StackError, held, log_file, logs_folder
from deploy.compose.life import environment
from deploy.compose.lives import Lives
from deploy.compose.logs import Log
from deploy.compose.phases import NEVER_S, ProcessState
from deploy.compose.server import serve
from deploy.compose.stack_file import SUPERVISOR, LogLimits, Stack
from deploy.compose.states import StackStates
from deploy.compose.view import ProcessView, StackView
from services.bus.process_stat import ProcessStat

GAP_PERIOD_S = 1.0
EXIT_REFUSED = 2


class StackSupervisor:
    """Supervises one stack until it is told to go."""

    def __init__(self, stack: Stack, folder: Path, cleared: int) -> None:
        self._stack, self._folder, self._cleared = stack, folder, cleared
        self._loop = asyncio.get_running_loop()
        self._since = datetime.now(UTC)
        self._changed: dict[str, datetime] = {}
        self._states = StackStates()
        self._signals: Counter[str] = Counter()
        self._over: asyncio.Future[None] = self._loop.create_future()
        self._leaving = False
        self._timer: asyncio.TimerHandle | None = None
        self._logs = logs_folder(stack)
        self._journal = Log(log_file(self._logs, SUPERVISOR), LogLimits())
        self._bus = StackBus(folder, stack.name, stack.bus)
        self._lives = Lives(folder, self._logs, self._bus, self.tell)
        self._loop.set_exception_handler(self._crash)
        for one in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            self._loop.add_signal_handler(one, self._signalled, one)

    async def run(self) -> None:
        """Bring the stack up; return when it is down."""
        self._note("up", pid=os.getpid(), cleared=self._cleared)
        self._bus.listen(self._lives.announced, self.view)
        server = await serve(self._folder, self.answer)
        gaps = asyncio.create_task(self._tell_gaps())
        try:
            self.tell(Declare(self._stack.processes))
            await self._over
            self._note("down", signals=dict(self._signals))
        except BaseException as error:
            self._note("crashed", error=repr(error))
            raise
        finally:
            gaps.cancel()
            server.close()
            self._lives.close()
            self._bus.close()
            self._journal.close()

    # -- orders ------------------------------------------------------------------------------------

    def answer(self, request: Request) -> StackView:
        """Take an order; the state after it was taken.

        :raises RefusedError: if it cannot be carried out.
        """
        names = request.names or tuple(self._states.processes)
        unknown = [name for name in names if name not in self._states.processes]
        if unknown:
            known = ", ".join(self._states.processes)
            raise RefusedError(f"no process {unknown[0]!r} in stack {self._stack.name}; there are: {known}")
        if self._leaving and request.do not in ("tell", "down"):
            raise RefusedError(f"stack {self._stack.name} is going down")
        if request.do != "tell":
            self._note("asked", order=request.do, names=list(request.names))
        match request.do:
            case "declare":
                assert request.stack is not None  # noqa: S101 - checked by the model
                self._declare(request.stack)
            case "start":
                self.tell(Want(names))
            case "stop":
                self.tell(Unwant(names))
            case "restart":
                for name in names:
                    self.tell(Again(name))
            case "down":
                self.leave()
        return self.view()

    def _declare(self, stack: Stack) -> None:
        if (stack.name, stack.logs, stack.bus) != (self._stack.name, self._stack.logs, self._stack.bus):
            raise RefusedError("name, logs and bus change only after zenfi down")
        self._stack = stack
        self.tell(Declare(stack.processes))

    def leave(self) -> None:
        """Go down in order; asked again, at once."""
        if self._leaving:
            self._lives.kill_all()
        self._leaving = True
        self.tell(Unwant(tuple(self._states.processes)))

    def _signalled(self, number: signal.Signals) -> None:
        self._signals[number.name] += 1
        self._note("signal", signal=number.name)
        self.leave()

    # -- events ------------------------------------------------------------------------------------

    def tell(self, event: Event) -> None:
        """Take in what has happened and do what follows."""
        before = dict(self._states.processes)
        for action in self._states.handle(event, self._loop.time()):
            match action:
                case Launch(name, _, spec):
                    space = namespace(self._stack.name)
                    self._lives.launch(action, environment(spec, self._folder, space))
                case Ask(name, number):
                    self._lives.send(name, number)
                case Kill(name):
                    self._lives.send(name, signal.SIGKILL)
        self._tell_changes(before)
        if self._timer is not None:
            self._timer.cancel()
        due_s = self._states.next_s
        self._timer = self._loop.call_at(due_s, self.tell, Passed()) if due_s < NEVER_S else None
        if self._leaving and self._states.at_rest and not self._over.done():
            self._over.set_result(None)

    def _tell_changes(self, before: dict[str, ProcessState]) -> None:
        # One process's end or readiness comes before what follows from it for others.
        follows = ("starting", "stopping")
        for name, state in sorted(self._states.processes.items(), key=lambda item: item[1].phase in follows):
            was = before.get(name, ProcessState())
            if name not in before or state.phase != was.phase or state.life != was.life:
                self._changed[name] = datetime.now(UTC)
                reason = {"reason": state.reason} if state.reason else {}
                self._note(state.phase, process=name, life=state.life, **reason)
                self._bus.publish(self._process(name, {}))
            elif state.killed and not was.killed:
                self._note("killed", process=name, life=state.life)

    def _note(self, event: str, **more: Any) -> None:
        """A line of the supervisor's own log."""
        self._journal.take(json.dumps({"event": event, **more}).encode() + b"\n")

    async def _tell_gaps(self) -> None:
        while True:
            await asyncio.sleep(GAP_PERIOD_S)
            for log in self._lives.logs.values():
                log.tell_gap_if_over()

    def _crash(self, _: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """A bug of ours in a callback ends the supervisor; keepers then end everything else."""
        if not self._over.done():
            error = context.get("exception") or RuntimeError(context["message"])
            self._over.set_exception(error)

    # -- what is told ------------------------------------------------------------------------------

    def view(self) -> StackView:
        """The state of everything."""
        return StackView(
            name=self._stack.name,
            host=host(),
            pid=os.getpid(),
            since=self._since,
            leaving=self._leaving,
            folder=self._folder,
            namespace=namespace(self._stack.name),
            log=self._journal.path,
            cleared=self._cleared,
            strays=self._lives.strays,
            stale=self._states.stale,
            signals=dict(self._signals),
            processes=tuple(
                self._process(name, life.family() if (life := self._lives.now.get(name)) else {})
                for name in self._states.processes
            ),
        )

    def _process(self, name: str, family: dict[int, ProcessStat]) -> ProcessView:
        state, life, lives = self._states.processes[name], self._lives.now.get(name), self._lives
        cpu_s = sum(stat.cpu_s for stat in family.values())
        return ProcessView(
            name=name,
            phase=state.phase,
            wanted=state.wanted,
            since=self._changed[name],
            pid=life.pid or None if life is not None else None,
            life=state.life,
            restarts=state.restarts,
            status=state.status,
            reason=state.reason,
            processes=len(family),
            cpu_s=cpu_s,
            cpu_percent=100 * cpu_s / max(life.age_s, 0.01) if life is not None else 0.0,
            memory_bytes=sum(stat.memory_bytes for stat in family.values()),
            lost_lines=lives.logs[name].lost if name in lives.logs else 0,
            cleared=lives.cleared.get(name, 0),
            unkilled=lives.unkilled.get(name, 0),
            log=log_file(self._logs, name),
        )


def main() -> None:
    """Entry point: a line of JSON on standard input says what to supervise, where, and for how long.

    With ``attached``, standard input stays open as long as whoever started us lives. Exit status 2: refused,
    with one line that says why.
    """
    order = json.loads(sys.stdin.buffer.readline())
    stack = Stack.model_validate(order["stack"])
    folder = Path(order["folder"])
    try:
        with held(folder):
            become_subreaper()
            asyncio.run(_supervise(stack, folder, clear_marked(folder), attached=order["attached"]))
    except StackError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(EXIT_REFUSED)


async def _supervise(stack: Stack, folder: Path, cleared: int, *, attached: bool) -> None:
    supervisor = StackSupervisor(stack, folder, cleared)
    if attached:
        loop = asyncio.get_running_loop()

        def parent_is_gone() -> None:
            loop.remove_reader(sys.stdin)
            supervisor.leave()

        loop.add_reader(sys.stdin, parent_is_gone)
    await supervisor.run()


if __name__ == "__main__":
    main()
