"""Starting a supervisor: attached to whoever starts it, or left behind on purpose (``zenfi up -d``)."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import dataclass

from deploy.compose.control import NotUpError, RefusedError, Request, ask
from deploy.compose.daemon import EXIT_REFUSED
from deploy.compose.folder import logs_folder, stack_folder
from deploy.compose.stack_file import SUPERVISOR, Stack
from deploy.compose.view import StackView
from deploy.supervisor import InfrastructureError

_POLL_S = 0.02


@dataclass(frozen=True, slots=True)
class Started:
    """A supervisor that answers. Closing the standard input of an attached one makes it go down."""

    process: subprocess.Popen[bytes]
    view: StackView


def start(stack: Stack, *, attached: bool) -> Started:
    """Start the supervisor of a stack and wait until it answers.

    It has a session of its own: Ctrl-C at the terminal is for whoever started it.

    :raises RefusedError: if it finds that it cannot be, with the reason.
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
            view = ask(folder, Request(do="tell"))
        except NotUpError:
            if process.poll() is None:
                time.sleep(_POLL_S)
                continue
            said = errors.read_text(errors="replace").strip().splitlines() or [f"exit {process.returncode}"]
            if process.returncode == EXIT_REFUSED:
                raise RefusedError(said[-1]) from None
            message = f"the supervisor did not start: {said[-1]}"
            raise InfrastructureError(message) from None
        return Started(process, view)
