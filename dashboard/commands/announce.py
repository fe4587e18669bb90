"""``zenfi announce``: the wrapper that makes somebody else's process a node of a stack."""

from __future__ import annotations

import os
import re
import signal
import sys
from pathlib import Path

import click

from deploy.compose.stack_file import NAME
from deploy.compose.wrapper import run_announced
from deploy.errors import BadSpecError


@click.command(context_settings={"ignore_unknown_options": True})
@click.option("--name", help="By which it is announced.  [default: the program's]")
@click.argument("command", nargs=-1, required=True, type=click.UNPROCESSED)
def announce(name: str | None, command: tuple[str, ...]) -> None:
    """Run a program of anybody's, announced, so that zenfi inject --node finds it: announce -- CMD ...

    For a process of a stack file (zenfi up); see docs/own_stack.md.
    """
    called = Path(command[0]).name if name is None else name
    if not re.fullmatch(NAME, called):
        message = f"--name: {called!r} is no name: lower-case letters, digits, - and _, at most 31"
        raise BadSpecError(message)
    status = run_announced(called, command)
    if status < 0:
        signal.signal(-status, signal.SIG_DFL) if -status not in (signal.SIGKILL, signal.SIGSTOP) else None
        os.kill(os.getpid(), -status)
    sys.exit(status)
