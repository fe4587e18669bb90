"""One injection into any process that we may trace, from beginning to end, and what became of it."""

from __future__ import annotations

import os
import time
from dataclasses import asdict, replace
from typing import Literal

import numpy as np
from pydantic import Field

from injector.attach.approach import AttachApproach, AttachTarget
from injector.attach.call_approach import CallApproach
from injector.attach.permission import AttachRefusedError, changed, name_of, not_permitted
from injector.attach.stopped_process import StoppedApproach
from injector.attach.untrapped_tracees import UntrappedTracees, notice_for
from injector.faults.corruption import CORRUPTIONS
from injector.faults.record import record_of
from injector.faults.stopped_thread import InjectionResult
from injector.tracing.elf import place
from injector.tracing.process import ChangedError, MemoryMap, Process, VanishedError
from injector.tracing.ptrace import NotPermittedError
from injector.tracing.source_lines import SourceLines
from injector.tracing.waiting import wait_until
from services.models.base import Strict
from services.models.faults.specification import FaultSpec
from services.models.outcome import InjectionRecord
from services.system.process_stat import is_stopped
from services.system.signal_names import signal_name

ENDED = "the process ended before the fault"

ENDING_MS = 200
"""Longest wall time for a process to be gone of which something is missing already."""

STOPPING_S = 1.0
"""Longest wait for a process that was stopped before to be stopped again."""

MAKING_S = 0.5
"""Longest wait for threads that block all signals because they are being made."""


class Aftermath(Strict):
    """What happened to the process within ``watched_s`` of wall time after the fault.

    ``ended``: it did, and nobody told us how. ``stopped``: it had been before, and is again.
    """

    result: Literal["lives", "stopped", "killed", "exited", "ended"]
    signal: str = Field(default="", description="that killed it")
    exit_status: int | None = None
    after_s: float | None = Field(default=None, description="wall time from the fault to its end")
    watched_s: float


class ProcessInjection(Strict):
    """One injection into a process that was named by its pid.

    ``call`` counts the function's calls from 1, without the ``rehearsals``: calls that are observed first, to
    learn how long they are; ``step`` counts instructions of the
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
    missed: int = Field(default=0, description="calls that were over before what was drawn for them")
    hit: int | None = Field(default=None, description="which pass through the instruction, in a counted call")
    uncounted: str = Field(default="", description="why a long call was not counted but its moment drawn")
    injection: InjectionRecord
    aftermath: Aftermath


def inject_into(
    process: Process,
    target: AttachTarget,
    fault: FaultSpec,
    draw: np.random.Generator,
    *,
    node: str = "",
    library: str = "",
    dry_run: bool = False,
    watch_s: float = 1.0,
) -> ProcessInjection:
    """Inject a fault into a process of which only the pid is known.

    With ``dry_run`` nothing is changed: what would be is written back as it is. ``node`` is the name by which
    it is announced, ``library`` what ``target`` names, for the record. When this returns
    or raises, nobody is traced.

    :raises AttachRefusedError: if the kernel forbids it, or no thread can be stopped.
    :raises VanishedError: if the process ended before we had hold of it. Later, that is in the record.
    :raises TriggerError, StopError: as :func:`injector.flight.injection.inject` does.
    """
    # A thread that is just being made blocks every signal for a moment.
    notice = wait_until(lambda: notice_for(target.tids) if process.alive else 0, MAKING_S) or None
    if notice is None and not process.alive:
        raise VanishedError(ENDED)
    if notice is None:
        raise AttachRefusedError(
            f"process {process.pid} blocks the signals by which a thread is stopped there"
        )
    stopped = is_stopped(process.pid)
    told = {"process": name_of(process.pid), "executable": _executable(process.pid)}
    with UntrappedTracees(process, notice) as tracees:
        _seize(tracees, process)
        done = fault.model_copy(update={"model": "none"}) if dry_run else fault
        corruption = CORRUPTIONS[fault.model]
        one: AttachApproach | StoppedApproach
        if stopped:
            one = StoppedApproach(tracees, process, target.tids[0], done, corruption, draw)
        else:
            kind = AttachApproach if target.function is None else CallApproach
            one = kind(tracees, process, target, done, fault, corruption, draw)
        result = one.run()
        maps, thread = process.maps(), name_of(one.report.tid)
        if not stopped:
            tracees.resume_all()
            aftermath = _watch(tracees, process, watch_s)
    if stopped:
        aftermath = _left_stopped(process, watch_s)
    # Untraced: while we hold its threads, nobody hears of its end.
    if result.status == "failed" and not result.bits and process.ends_within(ENDING_MS):
        result = replace(result, reason=ENDED)
        aftermath = aftermath if aftermath.result != "lives" else Aftermath(result="ended", watched_s=watch_s)
    drawn = {name: value for name, value in asdict(one.report).items() if name not in ("precision", "tid")}
    return ProcessInjection(
        **told,
        thread=thread,
        function=target.function.name if target.function is not None else "",
        library=library,
        seed=fault.seed,
        dry_run=dry_run,
        **drawn,
        injection=_record(fault, one, maps, result, node=node, dry_run=dry_run),
        aftermath=aftermath,
    )


def _seize(tracees: UntrappedTracees, process: Process) -> None:
    """Seize all threads of a process, which is checked once more now that it cannot change.

    :raises AttachRefusedError: if the kernel forbids it, or it is another process by now.
    """
    try:
        tracees.seize([process.pid])
    except NotPermittedError as error:
        raise AttachRefusedError(not_permitted(process.pid)) from error
    try:
        process.verify()
    except ChangedError as error:
        raise AttachRefusedError(changed(process.pid)) from error


def _record(
    fault: FaultSpec,
    approach: AttachApproach | StoppedApproach,
    maps: MemoryMap,
    result: InjectionResult,
    *,
    node: str,
    dry_run: bool,
) -> InjectionRecord:
    report, pid = approach.report, approach.process.pid
    record = record_of(
        result,
        fault,
        node=node,
        kernel="",
        invocation=report.call or 0,
        location=lambda address: place(pid, maps, address, lines=SourceLines()),
        precision=report.precision,
        pid=pid,
        tid=report.tid,
        pause_us=approach.tracees.pause_us,
        threads_stopped=approach.tracees.threads_stopped,
    )
    if dry_run and result.bits:
        return record.model_copy(update={"reason": "dry run: all was done but the flip"})
    return record


def ended_before(pid: int, name: str, fault: FaultSpec, *, node: str, dry_run: bool) -> ProcessInjection:
    """The record of a fault whose process ended before it could be traced."""
    return ProcessInjection(
        process=name,
        executable="",
        thread="",
        seed=fault.seed,
        dry_run=dry_run,
        injection=record_of(
            InjectionResult("failed", ENDED), fault, node=node, kernel="", invocation=0, pid=pid
        ),
        aftermath=Aftermath(result="ended", watched_s=0.0),
    )


def _executable(pid: int) -> str:
    try:
        return os.readlink(f"/proc/{pid}/exe")  # noqa: PTH115
    except OSError:
        return ""


def _left_stopped(process: Process, watch_s: float) -> Aftermath:
    """What becomes of a stopped process that is no longer traced: nothing, until somebody lets it go on."""
    pid = process.pid
    wait_until(lambda: True if is_stopped(pid) or not process.alive else None, STOPPING_S)
    end: Literal["stopped", "ended", "lives"] = "stopped" if is_stopped(pid) else "lives"
    return Aftermath(result=end if process.alive else "ended", watched_s=watch_s)


def _watch(tracees: UntrappedTracees, process: Process, watch_s: float) -> Aftermath:
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
        return Aftermath(result="killed", signal=signal_name(end.signal), **after, **watched)
    return Aftermath(result="exited", exit_status=end.exit_status, **after, **watched)
