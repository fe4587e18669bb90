"""One fault in any process that one may trace."""

from __future__ import annotations

from dataclasses import dataclass

from deploy.compose.wrapper import claim_of, the_stack, verify
from deploy.config.check import check_machine
from deploy.config.written_faults import fault_fields
from deploy.errors import BadSpecError, InfrastructureError
from injector.attach.approach import AttachTarget
from injector.attach.function_calls import CalledFunction
from injector.attach.injection import ENDED, ENDING_MS, ProcessInjection, ended_before, inject_into
from injector.attach.permission import AttachRefusedError, admit, check_runs, check_thread, name_of
from injector.faults.code_restorer import RestoredProcess
from injector.tracing.perf_events import TriggerError
from injector.tracing.process import AddressError, MemoryMap, Process, VanishedError, threads
from injector.tracing.ptrace import PtraceError
from injector.tracing.symbols import SymbolError, copies_elsewhere, module_code, variants_of
from injector.tracing.tracees import StopError
from services.models.faults.specification import FaultSpec
from services.runtime import rng

_OF_ONE_THAT_ENDS = (
    VanishedError,
    AttachRefusedError,
    SymbolError,
    TriggerError,
    StopError,
    PtraceError,
    AddressError,
    ProcessLookupError,
)
"""What may be raised because a process ends meanwhile; of one that lives it is raised on."""

_DECIDED_ELSEWHERE = ("scope", "trigger", "components", "point")


def inject(
    pid: int | None = None,
    *,
    node: str | None = None,
    stack: str | None = None,
    symbol: str | None = None,
    module: str | None = None,
    thread: int | None = None,
    fault: str = "",
    call: int | tuple[int, int] | None = None,
    step: int | None = None,
    cpu_s: float | tuple[float, float] | None = None,
    after_s: float | tuple[float, float] | None = None,
    seed: int = 0,
    dry_run: bool = False,
    watch_s: float = 1.0,
    limit_s: float = 60.0,
) -> ProcessInjection:
    """Flip bits of one register or word of a process, once, with all its threads stopped meanwhile.

    The process is ``pid``, or the ``node`` that is announced in a ``stack``. The instruction is one of a
    ``call`` of the function ``symbol`` (drawn uniformly, or the ``step``-th), or of the library ``module``,
    or wherever it is after ``cpu_s`` seconds of processor time; ``after_s`` is wall time to wait first.
    Of two numbers, one in between is drawn by ``seed``. ``fault`` is what is flipped, e.g.
    ``field=exponent,bits=2``. ``dry_run`` does everything but the flip; afterwards the process is watched
    for ``watch_s`` seconds. After ``limit_s`` seconds the injection is given up.

    :raises BadSpecError: if the process, the function or the fault cannot be had.
    :raises InfrastructureError: if one of its threads does not stop.
    """
    return inject_process(
        InjectionRequest(
            pid=pid,
            node=node,
            stack=stack,
            symbol=symbol,
            module=module,
            thread=thread,
            fault=fault,
            call=(call, call) if isinstance(call, int) else call,
            step=step,
            cpu_s=_range(cpu_s),
            after_s=_range(after_s),
            seed=seed,
            dry_run=dry_run,
            watch_s=watch_s,
            limit_s=limit_s,
        )
    )


def _range(given: float | tuple[float, float] | None) -> tuple[float, float] | None:
    return (given, given) if isinstance(given, int | float) else given


@dataclass(frozen=True, slots=True)
class InjectionRequest:
    """Which process is struck, where and when; of two numbers, one in between is drawn.

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
            raise BadSpecError("call and step go with symbol")
        if self.step is not None and self.cpu_s is not None:
            raise BadSpecError("step and cpu_s both say where in the call: leave out one")
        if (self.pid is None) == (self.node is None) or (self.stack is not None and self.node is None):
            raise BadSpecError("pid or node says which process; stack goes with node")


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
            except _OF_ONE_THAT_ENDS as error:
                if not isinstance(error, VanishedError) and not process.ends_within(ENDING_MS):
                    raise
            return ended_before(pid, name, fault, node=asked.node or "", dry_run=asked.dry_run)
    except (AttachRefusedError, SymbolError, TriggerError) as error:
        raise BadSpecError(str(error)) from error
    except StopError as error:
        raise InfrastructureError(str(error)) from error


def _attach_and_inject(asked: InjectionRequest, process: Process, fault: FaultSpec) -> ProcessInjection:
    aim = _aim(asked, process)
    return inject_into(
        process,
        aim,
        fault,
        rng.generator(asked.seed, "any process"),
        node=asked.node or "",
        library=asked.module or "",
        dry_run=asked.dry_run,
        watch_s=asked.watch_s,
    )


def _fault(asked: InjectionRequest, pid: int) -> FaultSpec:
    fields = fault_fields(asked.fault)
    for name in _DECIDED_ELSEWHERE:
        if name in fields:
            message = f"fault: {name} goes with flights; here symbol, module and the other options say it"
            raise BadSpecError(message)
    target = asked.symbol or asked.module or f"pid {pid}"
    spec = FaultSpec.model_validate({"target": target, "seed": asked.seed, **fields})
    check_machine(spec)
    return spec


def _aim(asked: InjectionRequest, process: Process) -> AttachTarget:
    """The thread and the code at which a request aims."""
    if asked.thread is not None:
        check_thread(process.pid, asked.thread)
    for option in ("symbol", "module", "cpu_s", "after_s"):
        if getattr(asked, option) is not None:
            check_runs(process.pid, option)
    maps = process.maps()
    if next(maps.code(), None) is None:  # one that is about to end has no memory any more
        raise VanishedError(ENDED)
    symbol, module = asked.symbol, asked.module
    function = _function(process.pid, maps, symbol, module) if symbol else None
    every = (tuple(threads(process.pid)) if symbol else ()) or (process.pid,)
    return AttachTarget(
        tids=(asked.thread,) if asked.thread else every,
        function=function,
        code=module_code(maps, module) if module and not symbol else (),
        call=asked.call or (1, 1),
        step=asked.step,
        cpu_s=asked.cpu_s,
        after_s=asked.after_s or (0.0, 0.0),
        limit_s=asked.limit_s,
    )


def _function(pid: int, maps: MemoryMap, symbol: str, module: str | None) -> CalledFunction:
    variants = variants_of(pid, maps, symbol, module or "")
    return CalledFunction(variants, copies_elsewhere(pid, maps, variants) if module else ())
