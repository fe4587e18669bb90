"""How a supervisor is asked and ordered: a line of JSON each way over a Unix socket in its folder."""

from __future__ import annotations

import os
import select
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal, Self

from pydantic import ValidationError, model_validator

from deploy.compose.folder import CONTROL, StackError, check_private, stack_folder, stacks_folder
from deploy.compose.stack_file import Stack
from deploy.compose.view import StackView
from services.bus.model import Strict

LINE_BYTES = 1 << 24
_ANSWER_S = 60.0
_POLL_S = 0.05


class NotUpError(StackError):
    """No supervisor answers for the stack."""


class RefusedError(StackError):
    """The supervisor does not do what it was asked."""


class Request(Strict):
    """What somebody wants: to know the state, or to change it. ``names`` empty: every process."""

    do: Literal["tell", "declare", "start", "stop", "restart", "down"]
    names: tuple[str, ...] = ()
    stack: Stack | None = None

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if (self.do == "declare") != (self.stack is not None):
            raise ValueError("a stack is what declare takes")
        return self


class Answer(Strict):
    """What came of it: the state after the order was taken (not yet carried out), or why it was refused."""

    view: StackView | None = None
    error: str = ""


def parse(line: bytes) -> Request:
    """A request as it came.

    :raises RefusedError: if it is none.
    """
    try:
        return Request.model_validate_json(line)
    except ValidationError as error:
        raise RefusedError(f"not a request: {error.errors()[0]['msg']}") from error


def ask(folder: Path, request: Request) -> StackView:
    """Put a request to the supervisor of the stack in ``folder``; the stack's state.

    :raises NotUpError: if nobody answers.
    :raises RefusedError: if it was refused.
    """
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(_ANSWER_S)
        try:
            for one in (folder.parent, folder):
                check_private(one)
            connection.connect(str(folder / CONTROL))
            connection.sendall(request.model_dump_json().encode() + b"\n")
            with connection.makefile("rb") as answers:
                line = answers.readline(LINE_BYTES)
        except OSError as error:
            message = f"stack {folder.name} is not up: zenfi up"
            raise NotUpError(message) from error
    if not line:
        message = f"stack {folder.name} has just ended"
        raise NotUpError(message)
    answer = Answer.model_validate_json(line)
    if answer.view is None:
        raise RefusedError(answer.error)
    return answer.view


def state(name: str) -> StackView:
    """What the stack of that name is doing.

    :raises NotUpError: if it is not up.
    """
    return ask(stack_folder(name), Request(do="tell"))


def stacks_up() -> list[StackView]:
    """Every stack of this user that is up on this machine."""
    views = []
    for folder in sorted(stacks_folder().glob("*")):
        try:
            views.append(ask(folder, Request(do="tell")))
        except NotUpError:
            continue
    return views


def down(folder: Path) -> None:
    """Have a stack go down and wait until its supervisor is gone, which is the last of it.

    :raises NotUpError: if it is not up.
    """
    supervisor = os.pidfd_open(ask(folder, Request(do="tell")).pid)
    try:
        ask(folder, Request(do="down"))
        select.select([supervisor], [], [])
    finally:
        os.close(supervisor)


def wait(folder: Path, until: Callable[[StackView], bool]) -> StackView:
    """Wait until the stack's state is as wanted; that state.

    :raises NotUpError: if the supervisor ends meanwhile.
    """
    while not until(view := ask(folder, Request(do="tell"))):
        time.sleep(_POLL_S)
    return view
