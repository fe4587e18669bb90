"""Strike a node's calls many times in one run of the node, which no other node and no vehicle takes part in.

The node runs from the beginning of its flight and gets what it had got
(:mod:`injector.strikes.recorded_bus`). Before a call that is to be struck a copy is made, which stops at the
injector's gate as in a flight with the fault. Of that copy one more is made for each fault, where it
strikes; it runs to the end of the call.
"""

from __future__ import annotations

import json
import socket
import struct
from collections import defaultdict
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict
from pathlib import Path

from injector.block_profile.counted_call import UncountableError
from injector.faults.apply import apply_fault
from injector.faults.call_profile import CallProfile
from injector.faults.record import exact_site, record_of
from injector.faults.stopped_thread import InjectionResult
from injector.flight.fingerprint import fingerprint_of
from injector.flight.injection import POINTER_BITS
from injector.flight.site_draw import waypoint
from injector.kernel_study.checkpoints import CheckpointRun, Stop
from injector.kernel_study.remote_fork import RemoteForks
from injector.kernel_study.results import SamplePoint
from injector.strikes.copied_node import (
    OPEN_GATE,
    CopiedNode,
    DiedError,
    DisturbedCopyError,
    HangError,
    NonsenseEndError,
    asks_at_gate,
)
from injector.strikes.own_ends import link_of, own_link, own_page, stack_pointer
from injector.strikes.recorded_bus import EndOfRecordingError, RecordedBus, StrayedError, UnrecordedError
from injector.strikes.results import StrikeRecord, StrikeTask
from injector.strikes.state import difference, state_of
from injector.tracing import ptrace
from injector.tracing.compiled_functions import compiled_functions
from injector.tracing.elf import place
from injector.tracing.process import Process, ProcessIdentity
from injector.tracing.tracee import Tracee
from injector.tracing.tracees import TraceeGroup
from services.bus import proxy_link
from services.bus.horizon import Stamped
from services.bus.proxy_link import Frame, NonsenseError
from services.models.faults.specification import FaultSpec, Trigger
from services.runtime import rng
from services.runtime.kernel_timer import GATE_SIGNAL
from services.system.shared_stats import ARMED_INVOCATION_AT, NOT_ARMED, PAGE_BYTES, SharedStats, counts_in
from services.system.signal_names import signal_name

EXIT_BUG = 70
"""The exit status of a node that an exception has ended."""

HANG_S = 0.5
"""Thread time of a step after which a copy is taken to hang; whether it does, a flight tells."""

Calls = Mapping[int, Sequence[tuple[int, FaultSpec]]]
"""The faults of each call, by its number, with their own numbers."""


class Striker:
    """Goes through a node's flight once, and tells of each fault as soon as it is known."""

    def __init__(
        self,
        task: StrikeTask,
        kernel_place: int,
        messages: Mapping[str, Sequence[Stamped]],
        stats: SharedStats,
        tracees: TraceeGroup,
        log: Path,
    ) -> None:
        """Take the node's task; its kernel's counter is at ``kernel_place`` in the shared page.

        ``log`` is the file to which it writes.
        """
        self._task, self._place, self._stats, self._tracees = task, kernel_place, stats, tracees
        self._log = log
        self._bus = RecordedBus(task.node, messages, task.end_ns)
        self._forks = RemoteForks(tracees)
        self._calls: Calls = _by_call(task.faults)

    def run(self, pid: int, end: socket.socket) -> Iterator[StrikeRecord]:
        """Serve the node ``pid`` at the other end of a socket to its flight's end.

        :raises StrayedError: if the node, which nothing strikes, sends something else than in its flight.
        :raises DiedError, HangError, DisturbedCopyError: if it ends, or does not.
        """
        self._tracees.seize([pid])
        node = CopiedNode(self._tracees, self._tracees.threads[pid], end, self._bus, HANG_S)
        left = dict(self._calls)
        to_learn = self._task.watched
        with suppress(EndOfRecordingError):
            while True:
                frame = node.hear()
                if frame.kind == proxy_link.NEXT and to_learn:
                    self._learn(node, frame)
                    to_learn = False
                number = int(self._stats.page["invocations"][self._place])
                if frame.kind == proxy_link.NEXT and number in left:
                    came = yield from self._strike_next(node, frame, left[number])
                    if came:
                        del left[number]
                answer = self._bus.take(frame)
                if answer is not None:
                    node.say(answer)
        for faults in left.values():
            for index, _ in faults:
                yield StrikeRecord(index=index, result="undecided", cause="the flight ended before that call")

    def _strike_next(
        self, node: CopiedNode, frame: Frame, faults: Sequence[tuple[int, FaultSpec]]
    ) -> Generator[StrikeRecord, None, bool]:
        """Let a copy of the node, which waits for an answer, come to its call; whether it did at once."""
        with self._copied(node, frame, self._bus.copy(), _call_of(faults[0][1])) as (copy, process, page):
            begin_ns = _at_the_gate(copy)
            if begin_ns is None:
                return False
            copy.say(OPEN_GATE)
            copy.to_the_mark()
            call = StruckCall(self._task, begin_ns, copy, process, page, self._forks, self._log)
            yield from call.strike(faults)
            return True

    def _learn(self, node: CopiedNode, frame: Frame) -> None:
        """Let a copy of the node, which waits for its first answer, go through the flight before it."""
        bus = self._bus.learning()
        with self._copied(node, frame, bus, NOT_ARMED) as (copy, _, __), suppress(EndOfRecordingError):
            while True:
                answer = bus.take(copy.hear())
                if answer is not None:
                    copy.say(answer)

    @contextmanager
    def _copied(
        self, node: CopiedNode, frame: Frame, bus: RecordedBus, call: int
    ) -> Iterator[tuple[CopiedNode, Process, int]]:
        """A copy of the node, which waits for the answer to a frame; the copy gets it, and runs.

        ``call`` is that at whose beginning it is to ask at the gate. Also where its own page is.
        """
        answer = bus.take(frame)
        self._stop(node.thread)
        thread = self._forks.copy(node.thread)
        node.go()
        try:
            with Process(ProcessIdentity.of(thread.pid)) as process:
                page = own_page(thread, process)
                process.write_memory(page + ARMED_INVOCATION_AT, struct.pack("<q", call))
                with own_link(thread, process, link_of(thread.pid), stack_pointer(thread)) as link:
                    copy = CopiedNode(self._tracees, thread, link, bus, HANG_S)
                    copy.say(answer or b"")
                    copy.go()
                    yield copy, process, page
        finally:
            self._forks.end(thread)

    def _stop(self, thread: Tracee) -> None:
        """Have the node stand where it waits for its answer."""
        ptrace.interrupt(thread.tid)
        report = ptrace.await_report(thread.tid)
        if report.kind == "gone":
            raise DiedError(report)
        thread.report = report


def _at_the_gate(copy: CopiedNode) -> int | None:
    """Let a copy come to the gate: the virtual time there; None if its step has no such call."""
    while True:
        frame = copy.hear()
        if asks_at_gate(frame):
            return int(json.loads(frame.payload.partition(b"\0")[2])["virtual_time_ns"])
        if frame.kind == proxy_link.NEXT:
            return None
        answer = copy.bus.take(frame)
        if answer is not None:
            copy.say(answer)


def _by_call(faults: Sequence[FaultSpec]) -> Calls:
    calls: dict[int, list[tuple[int, FaultSpec]]] = defaultdict(list)
    for index, fault in enumerate(faults):
        calls[_call_of(fault)].append((index, fault))
    return calls


def _call_of(fault: FaultSpec) -> int:
    """The number of the call that a fault of a task strikes."""
    assert fault.trigger is not None  # noqa: S101 - a task's faults name their calls
    assert fault.trigger.invocation is not None  # noqa: S101
    return fault.trigger.invocation


class StruckCall:
    """Strikes copies of a node that stands at the beginning of one call."""

    def __init__(
        self,
        task: StrikeTask,
        begin_ns: int,
        node: CopiedNode,
        process: Process,
        page: int,
        forks: RemoteForks,
        log: Path,
    ) -> None:
        """Take the node at the beginning of its call, and let an unstruck copy run to the end of it.

        ``page`` is where it counts, ``log`` the file to which it writes.
        """
        self._task, self._begin_ns, self._page, self._log = task, begin_ns, page, log
        self._node, self._root, self._forks = node, process, forks
        self._compiled = compiled_functions()
        self._followed: dict[str, StrikeRecord] = {}
        with self._copied(node.thread) as (copy, its_process):
            copy.to_the_mark()
            self._golden = state_of(copy.thread, its_process)

    def strike(self, faults: Sequence[tuple[int, FaultSpec]]) -> Iterator[StrikeRecord]:
        """What becomes of each fault, in the order in which the call comes to where they strike."""
        alike: dict[FaultSpec, dict[int, FaultSpec]] = defaultdict(dict)
        for index, fault in faults:
            alike[fault.model_copy(update={"seed": 0, "trigger": None})][index] = fault
        for shape, some in alike.items():
            yield from self._strike_alike(shape, some)

    def _strike_alike(self, shape: FaultSpec, faults: Mapping[int, FaultSpec]) -> Iterator[StrikeRecord]:
        """Strike with faults that differ in their seeds only."""
        with self._copied(self._node.thread) as (copy, process):
            try:
                profile = CallProfile(copy.thread, process, shape, GATE_SIGNAL, self._compiled)
            except UncountableError as error:
                for index in faults:
                    yield StrikeRecord(index=index, result="undecided", cause=str(error))
                return
        points = []
        for index, fault in faults.items():
            drawn = profile.draw(rng.generator(self._task.seed, f"site {fault.target}", fault.seed))
            if drawn is None:
                yield StrikeRecord(index=index, result="undecided", cause="nothing eligible")
            else:
                points.append(SamplePoint(index=index, address=drawn.address, hit=drawn.hit))
        leaders = profile.counts.leaders
        thread = self._node.thread
        run = CheckpointRun(self._node.tracees, self._forks, thread, GATE_SIGNAL, shape, leaders)
        with closing(run.visit(run.in_order(points))) as visited:
            for stop in visited:
                yield self._strike(stop, faults[stop.point.index])

    def _strike(self, stop: Stop, fault: FaultSpec) -> StrikeRecord:
        point, there, way = stop
        with self._copied(there) as (copy, process):
            maps = process.maps()
            seen, pointers = fingerprint_of(copy.thread, process, maps)
            draw = rng.generator(self._task.seed, f"injection {fault.target}", fault.seed)
            found = apply_fault(self._node.tracees, copy.thread, process, fault, draw)
            if found is None:
                found = InjectionResult("not_activated", "the site is a system call")
            site = exact_site(place(process.pid, maps, point.address, self._compiled), point.hit)
            found_there = {"way": None if way is None else waypoint(process, way), **asdict(seen)}
            record = record_of(
                found,
                fault,
                node=self._task.node,
                kernel=fault.target,
                invocation=_call_of(fault),
                location=lambda address: place(process.pid, maps, address, self._compiled),
                precision="exact",
                trigger=Trigger(invocation=_call_of(fault), site=site.model_copy(update=found_there)),
                points_into=pointers.target(found.before) if found.width_bits == POINTER_BITS else "",
                virtual_time_ns=self._begin_ns,
                threads_stopped=1,
            )
            if not found.bits:
                return StrikeRecord(
                    index=point.index, result="undecided", cause=found.reason, injection=record
                )
            end = self._end(copy, process)
            return end.model_copy(update={"index": point.index, "injection": record})

    def _end(self, copy: CopiedNode, process: Process) -> StrikeRecord:
        """What becomes of a struck copy."""
        try:
            copy.to_the_mark()
            # What the call had written before the strike, the unstruck copy has written, too.
            written = frozenset(self._golden.pages)
            state = difference(state_of(copy.thread, process, written), self._golden, self._root)
            if not state:
                return StrikeRecord(index=0, result="same_memory", at_ns=self._begin_ns)
            if state not in self._followed:
                self._followed[state] = self._follow(copy, process).model_copy(update={"state": state})
            return self._followed[state]
        except (DiedError, HangError, DisturbedCopyError) as error:
            return self._ended(copy, error)

    def _follow(self, copy: CopiedNode, process: Process) -> StrikeRecord:
        """What becomes of a struck copy that stands at the end of its call."""
        link = link_of(process.pid)
        with own_link(copy.thread, process, link, stack_pointer(copy.thread)) as line:
            bus = self._node.bus.copy()
            return self._to_the_end(CopiedNode(copy.tracees, copy.thread, line, bus, HANG_S), process)

    def _to_the_end(self, copy: CopiedNode, process: Process) -> StrikeRecord:
        """Let a struck copy run on from the end of its call to that of the flight, or to where it shows."""
        copy.go()
        try:
            while True:
                frame = copy.hear()
                answer = OPEN_GATE if asks_at_gate(frame) else copy.bus.take(frame)
                if answer is not None:
                    copy.say(answer)
        except EndOfRecordingError:
            counts = counts_in(process.read_memory(self._page, PAGE_BYTES), self._task.end_ns)
            return StrikeRecord(index=0, result="same_messages", at_ns=copy.bus.now_ns, counts=counts)
        except StrayedError as error:
            topic, number, at_ns = error.strayed
            return StrikeRecord(index=0, result="strayed", topic=topic, number=number, at_ns=at_ns)
        except UnrecordedError as error:
            return StrikeRecord(index=0, result="undecided", cause=str(error), at_ns=copy.bus.now_ns)
        except (DiedError, HangError, DisturbedCopyError, NonsenseEndError, NonsenseError) as error:
            return self._ended(copy, error)

    def _ended(self, copy: CopiedNode, error: Exception) -> StrikeRecord:
        at_ns = copy.bus.now_ns
        if isinstance(error, HangError):
            return StrikeRecord(index=0, result="hang", at_ns=at_ns)
        if isinstance(error, DisturbedCopyError):
            return StrikeRecord(index=0, result="undecided", cause="disturbed from outside", at_ns=at_ns)
        if not isinstance(error, DiedError):
            return StrikeRecord(index=0, result="died", cause="nonsense", at_ns=at_ns)
        end = error.report
        if end.signal:
            cause = signal_name(end.signal)
        elif end.exit_status == EXIT_BUG:
            cause = self._log.read_text(errors="replace").strip().splitlines()[-1]
        else:
            cause = f"exit status {end.exit_status}"
        return StrikeRecord(index=0, result="died", cause=cause, at_ns=at_ns)

    @contextmanager
    def _copied(self, of: Tracee) -> Iterator[tuple[CopiedNode, Process]]:
        """A standing copy of what stands; gone afterwards."""
        thread = self._forks.copy(of)
        try:
            with Process(ProcessIdentity.of(thread.pid)) as process:
                node = self._node
                yield CopiedNode(node.tracees, thread, node.socket, node.bus, HANG_S), process
        finally:
            self._forks.end(thread)
