"""One injection into any process that we may trace, from beginning to end, and what became of it."""

from __future__ import annotations

import os
import signal
import time
from contextlib import ExitStack
from dataclasses import asdict
from typing import Literal

import numpy as np
from pydantic import Field

from injector.acts import ACTS
from injector.elf import place
from injector.foreign import RefusedError, changed, name_of, not_permitted
from injector.gentle import GentleTracees, notice_for
from injector.hunt import Aim, Found, Hunt
from injector.inject import Strike
from injector.process import ChangedError, Maps, Process, VanishedError
from injector.ptrace import NotPermittedError, wait_until
from services.bus.mission import FaultSpec
from services.bus.model import Strict
from services.bus.outcome import InjectionRecord

ENDED = "the process ended before the fault"


class Aftermath(Strict):
    """What became of the process within ``watched_s`` of wall time after the fault.

    ``ended``: it did, and nobody told us how.
    """

    result: Literal["lives", "killed", "exited", "ended"]
    signal: str = Field(default="", description="that killed it")
    exit_status: int | None = None
    after_s: float | None = Field(default=None, description="wall time from the fault to its end")
    watched_s: float


class ProcessInjection(Strict):
    """One injection into a process that was named by its pid.

    ``call`` counts the function's calls from 1, rehearsals left out; ``step`` counts instructions of the
    call from 0, of which the rehearsed call had ``instructions``; ``cpu_ns`` is thread time after the call's
    beginning, or after the start where no function was given.
    """

    process: str
    executable: str
    thread: str
    function: str = ""
    library: str = ""
    seed: int
    dry_run: bool
    call: int | None = None
    step: int | None = None
    instructions: int | None = None
    cpu_ns: int | None = None
    rehearsals: int = 0
    injection: InjectionRecord
    aftermath: Aftermath


def inject_into(
    process: Process,
    aim: Aim,
    fault: FaultSpec,
    draw: np.random.Generator,
    *,
    node: str = "",
    function: str = "",
    library: str = "",
    dry_run: bool = False,
    watch_s: float = 1.0,
) -> ProcessInjection:
    """Inject a fault into a process of which only the pid is known.

    With ``dry_run`` nothing is changed: what would be is written back as it is. ``node`` is the name by which
    it is announced, ``function`` and ``library`` are what ``aim`` names, for the record. When this returns or
    raises, nobody is traced.

    :raises RefusedError: if the kernel forbids it, or no thread can be stopped.
    :raises VanishedError: if the process ended before we had hold of it. Later, that is in the record.
    :raises TriggerError, FreezeError: as :func:`injector.session.inject` does.
    """
    notice = notice_for(aim.tids)
    if notice is None and not process.alive:
        raise VanishedError(ENDED)
    if notice is None:
        raise RefusedError(f"process {process.pid} blocks the signals by which a thread is stopped there")
    told = {"process": name_of(process.pid), "executable": _executable(process.pid)}
    with ExitStack() as held:
        tracees = held.enter_context(GentleTracees(process, notice))
        try:
            tracees.seize([process.pid])
        except NotPermittedError as error:
            raise RefusedError(not_permitted(process.pid)) from error
        try:
            process.verify()
        except ChangedError as error:
            raise RefusedError(changed(process.pid)) from error
        one = Hunt(
            tracees,
            process,
            aim,
            fault.model_copy(update={"model": "none"}) if dry_run else fault,
            ACTS[fault.model],
            draw,
        )
        strike = one.run()
        maps, thread = process.maps(), name_of(one.found.tid)
        tracees.resume_all()
        aftermath = _watch(tracees, process, watch_s)
    record = _record(process.pid, maps, fault, one.found, strike).model_copy(update={"node": node})
    if dry_run and strike.bits:
        record = record.model_copy(update={"reason": "dry run: all was done but the flip"})
    pause = {"pause_us": tracees.pause_us, "threads_stopped": tracees.threads_stopped}
    drawn = {name: value for name, value in asdict(one.found).items() if name not in ("mode", "tid")}
    return ProcessInjection(
        **told,
        thread=thread,
        function=function,
        library=library,
        seed=fault.seed,
        dry_run=dry_run,
        **drawn,
        injection=record.model_copy(update=pause),
        aftermath=aftermath,
    )


def never_struck(pid: int, name: str, fault: FaultSpec, *, node: str, dry_run: bool) -> ProcessInjection:
    """What is told of a fault whose process ended before we had hold of it."""
    return ProcessInjection(
        process=name,
        executable="",
        thread="",
        seed=fault.seed,
        dry_run=dry_run,
        injection=InjectionRecord(
            status="failed", reason=ENDED, node=node, kernel="", invocation=0, model=fault.model, pid=pid
        ),
        aftermath=Aftermath(result="ended", watched_s=0.0),
    )


def _executable(pid: int) -> str:
    try:
        return os.readlink(f"/proc/{pid}/exe")  # noqa: PTH115
    except OSError:
        return ""


def _record(pid: int, maps: Maps, fault: FaultSpec, found: Found, strike: Strike) -> InjectionRecord:
    record = InjectionRecord(
        status=strike.status,
        mode=found.mode,
        node="",
        kernel="",
        invocation=found.call or 0,
        model=fault.model,
        pid=pid,
        tid=found.tid,
    ).model_copy(update=strike.described())
    if strike.instruction is None:
        return record
    return record.model_copy(update=asdict(place(pid, maps, strike.instruction.address)))


def _watch(tracees: GentleTracees, process: Process, watch_s: float) -> Aftermath:
    """Let all run, and see what becomes of the process. We hear how it ends only as its tracer."""
    pid = process.pid
    begin = time.monotonic()

    def ended() -> bool | None:
        tracees.service()
        return True if pid in tracees.ends or not tracees.threads else None

    wait_until(ended, watch_s)
    end = tracees.ends.get(pid)
    watched = {"watched_s": watch_s}
    if end is None:
        return Aftermath(result="lives" if process.alive else "ended", **watched)
    after = {"after_s": round(time.monotonic() - begin, 4)}
    if end.signal:
        return Aftermath(result="killed", signal=signal.Signals(end.signal).name, **after, **watched)
    return Aftermath(result="exited", exit_status=end.exit_status, **after, **watched)
