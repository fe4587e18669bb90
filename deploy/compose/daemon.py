"""The supervisor of a stack: starts, watches and stops its processes as declared (``docs/supervisor.md``).

One thread, one loop. Events go into :class:`StackStates`, the actions that come out are carried out by
:class:`SupervisedProcesses`; every change is journalled and published on Zenoh. :func:`start` starts one,
attached to whoever starts it, or left behind on purpose (``zenfi up -d``).
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from deploy.compose import limits
from deploy.compose.bus import StackBus, host, namespace
from deploy.compose.control import (
    ControlRefusedError,
    ControlRequest,
    NotUpError,
    ProcessView,
    StackView,
    ask,
    serve,
)
from deploy.compose.events import Ask, Declare, Event, Kill, Launch, Probe, Restart, TimePassed, Unwant, Want
from deploy.compose.folder import StackError, held, log_file, logs_folder, stack_folder
from deploy.compose.limits import ImpossibleLimitError
from deploy.compose.logs import Log
from deploy.compose.process import environment
from deploy.compose.processes import SupervisedProcesses
from deploy.compose.stack_file import SUPERVISOR, LogLimits, Stack
from deploy.compose.state_machine import NEVER_S, ProcessState, StackStates
from deploy.compose.system.process_tree import become_subreaper, clear_marked
from deploy.errors import InfrastructureError
from services.system.process_stat import ProcessStat

LOOK_PERIOD_S = 1.0
EXIT_REFUSED = 2


class StackSupervisor:
    """Supervises one stack until it is asked to go down."""

    def __init__(self, stack: Stack, folder: Path, cleared: tuple[int, int]) -> None:
        self._stack, self._folder = stack, folder
        self._cleared, self._unkilled = cleared
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
        self._processes = SupervisedProcesses(folder, self._logs, self._bus, self.tell)
        self._loop.set_exception_handler(self._crash)
        for one in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            self._loop.add_signal_handler(one, self._signalled, one)

    async def run(self) -> None:
        """Bring the stack up; return when it is down."""
        self._note("up", pid=os.getpid(), cleared=self._cleared, unkilled=self._unkilled)
        self._bus.listen(self._processes.announced, self.view)
        server = await serve(self._folder, self.answer)
        looks = asyncio.create_task(self._look_regularly())
        try:
            self.tell(Declare(self._stack.processes))
            await self._over
            self._note("down", signals=dict(self._signals))
        except BaseException as error:
            self._note("crashed", error=repr(error))
            raise
        finally:
            looks.cancel()
            server.close()
            self._processes.close()
            self._bus.close()
            self._journal.close()

    # -- orders ------------------------------------------------------------------------------------

    def answer(self, request: ControlRequest) -> StackView:
        """Carry out a request; the state after it was taken.

        :raises ControlRefusedError: if it cannot be carried out.
        """
        names = request.names or tuple(self._states.processes)
        unknown = [name for name in names if name not in self._states.processes]
        if unknown:
            known = ", ".join(self._states.processes)
            raise ControlRefusedError(
                f"no process {unknown[0]!r} in stack {self._stack.name}; there are: {known}"
            )
        if self._leaving and request.do not in ("tell", "down"):
            raise ControlRefusedError(f"stack {self._stack.name} is going down")
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
                    self.tell(Restart(name))
            case "down":
                self.leave()
        return self.view()

    def _declare(self, stack: Stack) -> None:
        if (stack.name, stack.logs, stack.bus) != (self._stack.name, self._stack.logs, self._stack.bus):
            raise ControlRefusedError("name, logs and bus change only after zenfi down")
        try:
            limits.check(stack.processes)
        except ImpossibleLimitError as error:
            raise ControlRefusedError(str(error)) from error
        self._stack = stack
        self.tell(Declare(stack.processes))

    def leave(self) -> None:
        """Take the stack down in order; a second call kills every process at once."""
        if self._leaving:
            self._processes.kill_all()
        self._leaving = True
        self.tell(Unwant(tuple(self._states.processes)))

    def _signalled(self, number: signal.Signals) -> None:
        self._signals[number.name] += 1
        self._note("signal", signal=number.name)
        self.leave()

    # -- events ------------------------------------------------------------------------------------

    def tell(self, event: Event) -> None:
        """Pass an event to the state machine and carry out the actions that follow."""
        before = dict(self._states.processes)
        for action in self._states.handle(event, self._loop.time()):
            match action:
                case Launch(name, _, spec):
                    space = namespace(self._stack.name)
                    self._processes.launch(action, environment(spec, self._folder, space))
                case Probe(name):
                    self._processes.probe(name)
                case Ask(name, number):
                    self._processes.send(name, number)
                case Kill(name):
                    self._processes.send(name, signal.SIGKILL)
        self._tell_changes(before)
        if self._timer is not None:
            self._timer.cancel()
        due_s = self._states.next_s
        self._timer = self._loop.call_at(due_s, self.tell, TimePassed()) if due_s < NEVER_S else None
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
        """Write a line to the supervisor's own log."""
        self._journal.take(json.dumps({"event": event, **more}).encode() + b"\n")

    async def _look_regularly(self) -> None:
        while True:
            await asyncio.sleep(LOOK_PERIOD_S)
            self._processes.hold_limits()
            for log in self._processes.logs.values():
                log.tell_gap_if_over()

    def _crash(self, _: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """A bug of ours in a callback ends the supervisor; reapers then end everything else."""
        if not self._over.done():
            error = context.get("exception") or RuntimeError(context["message"])
            self._over.set_exception(error)

    # -- views -------------------------------------------------------------------------------------

    def view(self) -> StackView:
        """The state of the stack and of each of its processes."""
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
            unkilled=self._unkilled,
            strays=self._processes.strays,
            stale=self._states.stale,
            signals=dict(self._signals),
            processes=tuple(
                self._process(name, process.family() if (process := self._processes.now.get(name)) else {})
                for name in self._states.processes
            ),
        )

    def _process(self, name: str, family: dict[int, ProcessStat]) -> ProcessView:
        state, process, running = self._states.processes[name], self._processes.now.get(name), self._processes
        cpu_s = sum(stat.cpu_s for stat in family.values())
        return ProcessView(
            name=name,
            phase=state.phase,
            wanted=state.wanted,
            since=self._changed[name],
            pid=process.pid or None if process is not None else None,
            life=state.life,
            restarts=state.restarts,
            status=state.status,
            reason=state.reason,
            processes=len(family),
            cpu_s=cpu_s,
            cpu_percent=100 * cpu_s / max(process.age_s, 0.01) if process is not None else 0.0,
            memory_bytes=sum(stat.memory_bytes for stat in family.values()),
            memory_limit_bytes=self._states.specs[name].limits.memory_bytes,
            failed_probes=running.failed_probes(name),
            lost_lines=running.logs[name].lost if name in running.logs else 0,
            cleared=running.cleared.get(name, 0),
            unkilled=running.unkilled.get(name, 0),
            log=log_file(self._logs, name),
        )


def main() -> None:
    """Entry point: a line of JSON on standard input says what to supervise, where, and for how long.

    With ``attached``, standard input stays open as long as the parent process runs. Exit status 2: refused,
    with one line that says why.
    """
    order = json.loads(sys.stdin.buffer.readline())
    stack = Stack.model_validate(order["stack"])
    folder = Path(order["folder"])
    try:
        limits.check(stack.processes)
        with held(folder):
            become_subreaper()
            asyncio.run(_supervise(stack, folder, clear_marked(folder), attached=order["attached"]))
    except StackError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(EXIT_REFUSED)


async def _supervise(stack: Stack, folder: Path, cleared: tuple[int, int], *, attached: bool) -> None:
    supervisor = StackSupervisor(stack, folder, cleared)
    if attached:
        loop = asyncio.get_running_loop()

        def parent_is_gone() -> None:
            loop.remove_reader(sys.stdin)
            supervisor.leave()

        loop.add_reader(sys.stdin, parent_is_gone)
    await supervisor.run()


_POLL_S = 0.02


@dataclass(frozen=True, slots=True)
class StackStarted:
    """A supervisor that answers requests. Closing the standard input of an attached one makes it go down."""

    process: subprocess.Popen[bytes]
    view: StackView


def start(stack: Stack, *, attached: bool) -> StackStarted:
    """Start the supervisor of a stack and wait until it answers.

    It has a session of its own: Ctrl-C at the terminal is for whoever started it.

    :raises ControlRefusedError: if it finds that it cannot be, with the reason.
    :raises InfrastructureError: if it ends otherwise, with what it said last.
    """
    folder = stack_folder(stack.name)
    logs = logs_folder(stack)
    logs.mkdir(parents=True, exist_ok=True)
    errors = logs / f"{SUPERVISOR}.err"
    with errors.open("wb") as error_file:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "deploy.compose.daemon"],
            stdin=subprocess.PIPE,
            stdout=error_file,
            stderr=error_file,
            start_new_session=True,
        )
    order = {"stack": stack.model_dump(mode="json"), "folder": str(folder), "attached": attached}
    assert process.stdin is not None  # noqa: S101 - asked for
    try:
        process.stdin.write(json.dumps(order).encode() + b"\n")
        process.stdin.flush()
        if not attached:
            process.stdin.close()
    except BrokenPipeError:
        pass  # it has ended; what it said follows
    while True:
        try:
            view = ask(folder, ControlRequest(do="tell"))
        except NotUpError:
            if process.poll() is None:
                time.sleep(_POLL_S)
                continue
            said = errors.read_text(errors="replace").strip().splitlines() or [f"exit {process.returncode}"]
            if process.returncode == EXIT_REFUSED:
                raise ControlRefusedError(said[-1]) from None
            message = f"the supervisor did not start: {said[-1]}"
            raise InfrastructureError(message) from None
        return StackStarted(process, view)


if __name__ == "__main__":
    main()
