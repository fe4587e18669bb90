"""One fault in any process: what was asked for is checked, found and struck."""

from __future__ import annotations

from dataclasses import dataclass

from dashboard.commands.fault import fault_fields
from deploy.check import BadSpecError, check_machine
from deploy.compose.announced import claim_of, the_stack, verify
from deploy.supervisor import InfrastructureError
from injector.any_process import ENDED, ProcessInjection, inject_into, never_struck
from injector.foreign import RefusedError, admit, check_thread, name_of
from injector.freeze import FreezeError
from injector.hunt import Aim
from injector.process import Process, VanishedError, threads
from injector.restorer import RestoredProcess
from injector.symbols import SymbolError, demangled, function_at, module_code
from injector.trigger import TriggerError
from services.bus import rng
from services.bus.mission import FaultSpec

_DECIDED_ELSEWHERE = ("scope", "trigger", "components", "point")


@dataclass(frozen=True, slots=True)
class Asked:
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


def strike(asked: Asked) -> ProcessInjection:
    """Do it. A process that ends while we get hold of it is told of as one that ends before the fault.

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
                return _strike(asked, process, fault)
            except (VanishedError, RefusedError, SymbolError, TriggerError) as error:
                if process.alive and not isinstance(error, VanishedError):
                    raise
            return never_struck(pid, name, fault, node=asked.node or "", dry_run=asked.dry_run)
    except (RefusedError, SymbolError, TriggerError) as error:
        raise BadSpecError(str(error)) from error
    except FreezeError as error:
        raise InfrastructureError(str(error)) from error


def _strike(asked: Asked, process: Process, fault: FaultSpec) -> ProcessInjection:
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


def _fault(asked: Asked, pid: int) -> FaultSpec:
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


def _aim(asked: Asked, process: Process) -> tuple[Aim, str]:
    """Where to strike, and the name of the function there, if one was asked for."""
    if asked.thread is not None:
        check_thread(process.pid, asked.thread)
    maps = process.maps()
    if next(maps.code(), None) is None:  # one that is about to end has no memory any more
        raise VanishedError(ENDED)
    symbol, module = asked.symbol, asked.module
    entry, mangled = function_at(process.pid, maps, symbol, module or "") if symbol else (0, "")
    every = (tuple(threads(process.pid)) if symbol else ()) or (process.pid,)
    aim = Aim(
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
