"""``zenfi inject`` strikes any process once; ``zenfi announce`` makes a program one that it finds by name."""

from __future__ import annotations

import os
import re
import signal
import sys
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from dashboard.terminal.injection_card import card
from dashboard.terminal.options import as_json
from deploy.compose.stack_file import NAME
from deploy.compose.wrapper import run_announced
from deploy.errors import BadSpecError
from zenfi.injection import InjectionRequest, inject_process


class Range(click.ParamType[tuple[float, float]]):
    """A number, or two with a hyphen between, of which one in between is drawn."""

    name = "range"

    def __init__(self, *, whole: bool = False) -> None:
        self._whole = whole

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float]:
        """Both ends; of a single number twice the same."""
        low, hyphen, high = str(value).partition("-")
        number = int if self._whole else float
        try:
            bounds = number(low), number(high if hyphen else low)
        except ValueError:
            bounds = 1, 0
        if not (1 if self._whole else 0) <= bounds[0] <= bounds[1] <= 1e9:
            what = "N or N-M from 1 on" if self._whole else "seconds, or two numbers of seconds: S or S-T"
            self.fail(f"expected {what}, got {value!r}", param, ctx)
        return bounds


@click.command(short_help="Inject one fault into any process.")
@click.option("--pid", type=click.IntRange(1), help="The process.")
@click.option("--node", metavar="NAME", help="The process that zenfi announce has announced so in a stack.")
@click.option("--stack", metavar="NAME", help="Which stack; needed if several are up.")
@click.option(
    "--symbol", metavar="NAME", help="Inject in a call of this function: its C, C++ or mangled name."
)
@click.option(
    "--module", metavar="LIB", help="Inject in this library; with --symbol: the function is this library's."
)
@click.option("--thread", type=click.IntRange(1), metavar="TID", help="Inject into this thread.")
@click.option("--fault", default="", metavar="NAME=VALUE[,...]", help="What is flipped, e.g. field=exponent.")
@click.option(
    "--call",
    type=Range(whole=True),
    metavar="N|N-M",
    help="Which call after the profiled ones.  [default: 1]",
)
@click.option(
    "--step",
    type=click.IntRange(0, 1_000_000),
    help="Which instruction of the call, from 0: no call is profiled.",
)
@click.option(
    "--cpu-s",
    type=Range(),
    metavar="S|S-T",
    help="Processor time of the thread before the injection, from the beginning of the call if there is one: "
    "no call is profiled.  [default: 0-0.01 without --symbol]",
)
@click.option("--after-s", type=Range(), metavar="S|S-T", help="Wall time to wait first.  [default: 0]")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True)
@click.option("--dry-run", is_flag=True, help="Do everything except for the flip.")
@click.option(
    "--watch-s",
    type=click.FloatRange(0, 3600),
    default=1.0,
    show_default=True,
    help="Seconds to watch the process after the injection.",
)
@click.option(
    "--limit-s",
    type=click.FloatRange(0.1, 86400),
    default=60.0,
    show_default=True,
    help="Seconds after which to give up.",
)
@as_json
def inject(*, as_json: bool, **typed: Any) -> None:
    """Inject one fault into any process that you may trace.

    With --symbol, the instruction is drawn uniformly over those of a call of that function, of any library
    and in whichever thread calls it first. How many there are is learned by stepping through an earlier
    call; if that is too long (2 ms or 20,000 instructions), a moment of the call's processor time is drawn
    instead.

    With --module, the fault is injected at a random moment at which it executes code of that library; with
    neither, after a random time of its processor time. The thread is the main one if --thread does not say
    otherwise.

    All threads are stopped while the bit is flipped, then continue. The process goes on if zenfi is killed.

    Exit status 0 if the fault was injected (or all was done but the flip), 1 if not, 2 if it was refused.
    """
    done = inject_process(InjectionRequest(**typed))
    if as_json:
        click.echo(done.model_dump_json(by_alias=True))
    else:
        Console(highlight=False, soft_wrap=True).print(card(done), markup=False)
    if done.injection.status != "injected" and not (typed["dry_run"] and done.injection.bits):
        sys.exit(1)


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
