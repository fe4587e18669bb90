"""The control socket of a supervisor: requests and the stack's state, a line of JSON each way."""

from __future__ import annotations

import asyncio
import os
import select
import socket
import time
from collections.abc import Callable, Mapping
from datetime import datetime
from pathlib import Path
from typing import Literal, Self

from pydantic import ValidationError, model_validator

from deploy.compose.folder import CONTROL, StackError, check_private, stack_folder, stacks_folder
from deploy.compose.stack_file import Stack
from deploy.compose.state_machine import MOVING, Phase
from services.models.base import Strict
from services.system.json_lines import line_of


class ProcessView(Strict):
    """The state of one process of a stack, as its supervisor reports it.

    ``processes``, ``cpu_s`` and ``memory_bytes`` are of its whole family now alive (``memory_bytes`` counts
    shared pages with each); ``cpu_percent`` is ps(1)'s: of one processor, over the time that it has run.
    ``life`` counts its starts, ``restarts`` those of them that its policy ordered. ``status`` is of the last
    end, negative for a signal. ``cleared`` counts the processes that had to be killed after their
    leader had ended, ``unkilled`` those of other users that could not be. ``failed_probes`` are those in a
    row that failed last.
    """

    name: str
    phase: Phase
    wanted: bool
    since: datetime
    pid: int | None
    life: int
    restarts: int
    status: int | None
    reason: str
    processes: int
    cpu_s: float
    cpu_percent: float
    memory_bytes: int
    memory_limit_bytes: int | None
    failed_probes: int
    lost_lines: int
    cleared: int
    unkilled: int
    log: Path


class StackView(Strict):
    """The state of one stack, as its supervisor (process ``pid``) reports it.

    ``cleared`` counts processes of an earlier supervisor of the stack, killed at the start, ``unkilled``
    those of other users that could not be, ``strays`` those that were left by a reaper that somebody
    killed, ``stale`` events of starts that were over.
    """

    name: str
    host: str
    pid: int
    since: datetime
    leaving: bool
    folder: Path
    namespace: str
    log: Path
    cleared: int
    unkilled: int
    strays: int
    stale: int
    signals: Mapping[str, int]
    processes: tuple[ProcessView, ...]

    @property
    def moving(self) -> bool:
        """Whether something is under way; else every process is ready, at rest, or waits in vain."""
        return any(one.phase in MOVING for one in self.processes)

    @property
    def amiss(self) -> list[ProcessView]:
        """The processes that failed, then those that wait for one that did."""
        return [one for phase in ("failed", "pending") for one in self.processes if one.phase == phase]


LINE_BYTES = 1 << 24
_ANSWER_S = 60.0
_POLL_S = 0.05


class NotUpError(StackError):
    """No supervisor answers for the stack."""


class ControlRefusedError(StackError):
    """The supervisor refuses the request."""


class ControlRequest(Strict):
    """A request for the state of a stack or for a change of it. ``names`` empty: every process."""

    do: Literal["tell", "declare", "start", "stop", "restart", "down"]
    names: tuple[str, ...] = ()
    stack: Stack | None = None

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if (self.do == "declare") != (self.stack is not None):
            raise ValueError("a stack is what declare takes")
        return self


class ControlAnswer(Strict):
    """The answer to a request: the state after it was taken (not yet carried out), or why it was refused."""

    view: StackView | None = None
    error: str = ""


def parse(line: bytes) -> ControlRequest:
    """Parse one line of JSON as a request.

    :raises ControlRefusedError: if it is none.
    """
    try:
        return ControlRequest.model_validate_json(line)
    except ValidationError as error:
        raise ControlRefusedError(f"not a request: {error.errors()[0]['msg']}") from error


def ask(folder: Path, request: ControlRequest) -> StackView:
    """Send a request to the supervisor of the stack in ``folder``; the stack's state.

    :raises NotUpError: if nobody answers.
    :raises ControlRefusedError: if it was refused.
    """
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(_ANSWER_S)
        try:
            for one in (folder.parent, folder):
                check_private(one)
            connection.connect(str(folder / CONTROL))
            connection.sendall(line_of(request))
            with connection.makefile("rb") as answers:
                line = answers.readline(LINE_BYTES)
        except OSError as error:
            message = f"stack {folder.name} is not up: zenfi up"
            raise NotUpError(message) from error
    if not line:
        message = f"stack {folder.name} has just ended"
        raise NotUpError(message)
    answer = ControlAnswer.model_validate_json(line)
    if answer.view is None:
        raise ControlRefusedError(answer.error)
    return answer.view


def state(name: str) -> StackView:
    """What the stack of that name is doing.

    :raises NotUpError: if it is not up.
    """
    return ask(stack_folder(name), ControlRequest(do="tell"))


def stacks_up() -> list[StackView]:
    """Every stack of this user that is up on this machine."""
    views = []
    for folder in sorted(stacks_folder().glob("*")):
        try:
            views.append(ask(folder, ControlRequest(do="tell")))
        except NotUpError:
            continue
    return views


def down(folder: Path) -> None:
    """Take a stack down and wait until its supervisor has ended.

    :raises NotUpError: if it is not up.
    """
    supervisor = os.pidfd_open(ask(folder, ControlRequest(do="tell")).pid)
    try:
        ask(folder, ControlRequest(do="down"))
        select.select([supervisor], [], [])
    finally:
        os.close(supervisor)


def wait(folder: Path, until: Callable[[StackView], bool]) -> StackView:
    """Wait until the stack's state is as wanted; that state.

    :raises NotUpError: if the supervisor ends meanwhile.
    """
    while not until(view := ask(folder, ControlRequest(do="tell"))):
        time.sleep(_POLL_S)
    return view


async def serve(folder: Path, answer: Callable[[ControlRequest], StackView]) -> asyncio.Server:
    """Answer requests on the control socket in ``folder``, which is private."""

    async def converse(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while line := await reader.readline():
                writer.write(line_of(_answer(line, answer)))
                await writer.drain()
        except (ConnectionError, ValueError):  # gone, or a line without end
            pass
        finally:
            writer.close()

    path = folder / CONTROL
    server = await asyncio.start_unix_server(converse, path, limit=LINE_BYTES)
    os.chmod(path, 0o600)  # noqa: PTH101 - the socket's own mode
    return server


def _answer(line: bytes, answer: Callable[[ControlRequest], StackView]) -> ControlAnswer:
    try:
        return ControlAnswer(view=answer(parse(line)))
    except ControlRefusedError as error:
        return ControlAnswer(error=str(error))
