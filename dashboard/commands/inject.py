"""``zenfi inject`` strikes any process once; ``zenfi announce`` makes a program one that it finds by name."""

from __future__ import annotations

import os
import re
import signal
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from dashboard.terminal.injection_card import card
from dashboard.terminal.options import as_json, fault_fields
from deploy.compose.stack_file import NAME
from deploy.compose.wrapper import claim_of, run_announced, the_stack, verify
from deploy.config.check import check_machine
from deploy.errors import BadSpecError, InfrastructureError
from injector.attach.approach import AttachTarget
from injector.attach.injection import ENDED, ProcessInjection, ended_before, inject_into
from injector.attach.permission import AttachRefusedError, admit, check_thread, name_of
from injector.faults.code_restorer import RestoredProcess
from injector.tracing.perf_events import TriggerError
from injector.tracing.process import Process, VanishedError, threads
from injector.tracing.symbols import SymbolError, demangled, function_at, module_code
from injector.tracing.tracees import StopError
from services.models.faults.specification import FaultSpec
from services.runtime import rng

_DECIDED_ELSEWHERE = ("scope", "trigger", "components", "point")


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


@dataclass(frozen=True, slots=True)
class InjectionRequest:
    """The options of ``zenfi inject``; of two numbers, one in between is drawn.

    :raises BadSpecError: if they contradict each other.
    """

    pid: int | None
    node: str | None
    stack: str | None
    symbol: str | None
    module: str | None
    thread: int | None
    fault: str
    call: tuple[int, int] | None
    step: int | None
    cpu_s: tuple[float, float] | None
    after_s: tuple[float, float] | None
    seed: int
    dry_run: bool
    watch_s: float
    limit_s: float

    def __post_init__(self) -> None:
        if self.symbol is None and (self.call, self.step) != (None, None):
            raise BadSpecError("--call and --step go with --symbol")
        if self.step is not None and self.cpu_s is not None:
            raise BadSpecError("--step and --cpu-s both say where in the call: leave out one")
        if (self.pid is None) == (self.node is None) or (self.stack is not None and self.node is None):
            raise BadSpecError("--pid or --node says which process; --stack goes with --node")


def inject_process(asked: InjectionRequest) -> ProcessInjection:
    """Inject one fault into a process. One that ends during the attachment counts as ended before the fault.

    :raises BadSpecError: if the process, the function or the fault cannot be had.
    :raises InfrastructureError: if one of its threads does not stop.
    """
    stack = the_stack(asked.stack) if asked.node is not None else None
    claim = claim_of(stack, asked.node) if stack is not None and asked.node is not None else None
    pid = claim.pid if claim is not None else asked.pid or 0
    fault = _fault(asked, pid)
    try:
        restored = fault.model == "opcode" and not asked.dry_run
        with admit(pid, RestoredProcess if restored else Process) as process:
            if claim is not None and stack is not None:
                verify(stack, claim)  # now that its pid cannot change hands
            name = name_of(pid)
            try:
                return _attach_and_inject(asked, process, fault)
            except (VanishedError, AttachRefusedError, SymbolError, TriggerError) as error:
                if process.alive and not isinstance(error, VanishedError):
                    raise
            return ended_before(pid, name, fault, node=asked.node or "", dry_run=asked.dry_run)
    except (AttachRefusedError, SymbolError, TriggerError) as error:
        raise BadSpecError(str(error)) from error
    except StopError as error:
        raise InfrastructureError(str(error)) from error


def _attach_and_inject(asked: InjectionRequest, process: Process, fault: FaultSpec) -> ProcessInjection:
    aim, function = _aim(asked, process)
    return inject_into(
        process,
        aim,
        fault,
        rng.generator(asked.seed, "any process"),
        node=asked.node or "",
        function=function,
        library=asked.module or "",
        dry_run=asked.dry_run,
        watch_s=asked.watch_s,
    )


def _fault(asked: InjectionRequest, pid: int) -> FaultSpec:
    fields = fault_fields(asked.fault)
    for name in _DECIDED_ELSEWHERE:
        if name in fields:
            message = (
                f"--fault: {name} goes with flights; here --symbol, --module and the other options say it"
            )
            raise BadSpecError(message)
    target = asked.symbol or asked.module or f"pid {pid}"
    spec = FaultSpec.model_validate({"target": target, "seed": asked.seed, **fields})
    check_machine(spec)
    return spec


def _aim(asked: InjectionRequest, process: Process) -> tuple[AttachTarget, str]:
    """Where to inject, and the name of the function there, if one was asked for."""
    if asked.thread is not None:
        check_thread(process.pid, asked.thread)
    maps = process.maps()
    if next(maps.code(), None) is None:  # one that is about to end has no memory any more
        raise VanishedError(ENDED)
    symbol, module = asked.symbol, asked.module
    entry, mangled = function_at(process.pid, maps, symbol, module or "") if symbol else (0, "")
    every = (tuple(threads(process.pid)) if symbol else ()) or (process.pid,)
    aim = AttachTarget(
        tids=(asked.thread,) if asked.thread else every,
        entry=entry,
        code=module_code(maps, module) if module and not symbol else (),
        call=asked.call or (1, 1),
        step=asked.step,
        cpu_s=asked.cpu_s,
        after_s=asked.after_s or (0.0, 0.0),
        limit_s=asked.limit_s,
    )
    return aim, demangled(mangled)


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
    asked = InjectionRequest(**typed)
    done = inject_process(asked)
    if as_json:
        click.echo(done.model_dump_json(by_alias=True))
    else:
        Console(highlight=False, soft_wrap=True).print(card(done), markup=False)
    if done.injection.status != "injected" and not (asked.dry_run and done.injection.bits):
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
