"""The calls of a node in which a fault recurs: the node is traced for as long as it lives.

In a marked call (:mod:`services.runtime.kernel_timer`) the code strikes, or traps where we are to; in between
it runs as it is. A record tells the strikes of each call, before the node goes on.
"""

from __future__ import annotations

import signal
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

from injector.block_profile.translation_memory import TranslationMemoryError
from injector.faults.code_scope import countable_code
from injector.faults.corruption import CORRUPTIONS, RegisterChange
from injector.faults.record import record_of
from injector.faults.stopped_thread import InjectionResult, StoppedThread, TargetError, registers_of
from injector.recurrence import schedule
from injector.recurrence.executions import DEADLY, executions_ahead
from injector.recurrence.strike_code import STRIKING, TRAPPING
from injector.recurrence.struck_code import FAR, StrikePlace, StruckCode
from injector.tracing import ptrace
from injector.tracing.compiled_functions import CompiledFunctions
from injector.tracing.elf import CodeLocations
from injector.tracing.process import AddressError, Process
from injector.tracing.ptrace import GoneError, StopReport
from injector.tracing.tracee import Tracee
from injector.tracing.tracees import TraceeGroup
from services.models.faults.specification import FaultSpec
from services.models.outcome import STRIKES_KEPT, InjectionRecord, strike_of
from services.runtime.kernel_timer import GATE_SIGNAL, MARKS, WITHIN

_MARKS = struct.Struct(f"<{MARKS}q")


@dataclass
class StrikeTally:
    """What outlasts a node that dies: how many strikes were told in full, and whether anything was told.

    ``executions`` are those that the last call had which came to its end.
    """

    kept: int = 0
    told: bool = False
    executions: int = 0


@dataclass
class _Call:
    """A call that is under way: which it is, from when to when, and its strikes so far.

    ``executions`` are those up to the next strike, of so many ``expected`` in the call.
    """

    invocation: int
    begin_ns: int
    end_ns: int
    gaps: Iterator[int] = field(default_factory=lambda: iter(()))
    executions: int = 0
    expected: int = 0
    attempts: int = 0
    strikes: int = 0
    records: list[InjectionRecord] = field(default_factory=list)
    failed: InjectionRecord | None = None

    @property
    def now_ns(self) -> int:
        """The virtual time of a strike: how far the call is, if that is known, else its beginning."""
        part = min(1.0, self.executions / self.expected) if self.expected else 0.0
        return self.begin_ns + round(part * (self.end_ns - self.begin_ns))


@dataclass
class StruckCalls:
    """Follows a node from the gate of its first such call to its end.

    The thread is seized and runs; ``marks`` is where the node says which call it is in, ``tell`` is given the
    records.
    """

    tracees: TraceeGroup
    thread: Tracee
    process: Process
    fault: FaultSpec
    node: str
    seed: int
    marks: int
    tell: Callable[[InjectionRecord], None]
    tally: StrikeTally
    compiled: CompiledFunctions | None = None
    own_code: Callable[[FaultSpec, Process], Sequence[tuple[int, int]]] = countable_code
    _code: StruckCode | None = None
    _places: CodeLocations | None = None
    _call: _Call | None = None

    def follow(self) -> None:
        """Serve the node until it is gone.

        :raises UnfollowedError: if it cannot be followed.
        """
        number: int | None = 0
        while True:
            try:
                report = self._next_report(number)
                if report.kind == "gone":
                    self.tracees.threads.pop(self.thread.tid, None)
                    self._lose_call()
                    return
                number = self._answer(report)
            except (GoneError, AddressError):
                number = None  # it was killed: that is reported next

    def _next_report(self, number: int | None) -> StopReport:
        tid, standing = self.thread.tid, self.thread.report
        self.thread.report = None
        with suppress(GoneError):
            if standing is not None and standing.kind == "group_stop":
                ptrace.listen(tid)
            elif standing is not None and number is not None:
                ptrace.resume(tid, number)
        try:
            report = ptrace.await_report(tid)
        except ChildProcessError:  # it went in a step
            report = StopReport("gone")
        self.thread.report = report
        return report

    def _answer(self, report: StopReport) -> int:
        """Do what a report asks for; the signal with which the thread goes on."""
        if report.kind in ("new_thread", "new_process"):
            message = f"process {self.process.pid} starts others while its code is in translation"
            raise UnfollowedError(message)
        if report.kind != "signal":
            return 0
        if report.signal == GATE_SIGNAL:
            self._at_mark()
            return 0
        if report.signal == signal.SIGTRAP and self._code is not None:
            place = self._code.place_at(ptrace.program_counter(self.thread.tid))
            if place is not None:
                return self._strike(place, self._code)
            if self._code.lead_on(self.thread.tid):
                return 0
        if report.signal in DEADLY:
            self._end_call()
        return report.signal

    # -- calls -------------------------------------------------------------------------------------

    def _at_mark(self) -> None:
        phase, *which = _MARKS.unpack(self.process.read_memory(self.marks, _MARKS.size))
        self._end_call(whole=True)
        if phase == WITHIN:
            self._begin_call(_Call(*which))

    def _begin_call(self, call: _Call) -> None:
        if self._code is None:
            try:
                self._code = self._translate()
            except TranslationMemoryError as error:
                self._tell_failure(call, str(error))
                return
        code, self._call = self._code, call
        if self.fault.recurrence == "permanent":
            code.put(code.words.strikes, 0)
            code.put(code.words.unread, 0)
            code.put(code.words.mode, TRAPPING if self.tally.kept < STRIKES_KEPT else STRIKING)
            return
        if self.fault.recurrence == "rate" and not self.tally.executions:
            self.tally.executions = executions_ahead(self.thread.tid, self.process, code)
        call.expected = self.tally.executions
        probability = schedule.chance(self.fault, call.end_ns - call.begin_ns, call.expected)
        call.gaps = schedule.gaps(self.fault, self.seed, call.invocation, probability)
        self._await_next(call, code)

    def _await_next(self, call: _Call, code: StruckCode) -> None:
        """Have the code trap at the next execution to be struck."""
        gap = next(call.gaps, FAR)
        call.executions += gap
        code.put(code.words.left, gap)

    def _translate(self) -> StruckCode:
        self._places = CodeLocations(self.process.pid, self.process.maps(), self.compiled)
        code = self.own_code(self.fault, self.process)
        return StruckCode(self.thread, self.process, code, self.fault, self.seed)

    def _end_call(self, *, whole: bool = False) -> None:
        call, self._call = self._call, None
        if call is None or self._code is None:
            return
        code = self._code
        if whole and self.fault.recurrence == "rate":
            self.tally.executions = call.executions - code.get(code.words.left)
        call.strikes += code.get(code.words.strikes)
        if code.get(code.words.unread):
            self._tell_failure(call, "a register did not take the change")
        code.put(code.words.strikes, 0)
        code.disarm()
        if call.failed is not None:
            self.tell(call.failed)
        if self.fault.model == "none":
            call.strikes = 0
        if call.records:
            self._tell_strikes(call)
        elif call.strikes:
            self._tell_count(call)
        elif not self.tally.told:
            self.tally.told = True
            self.tell(self._record(call, InjectionResult("not_activated", "no call was struck")))

    def _lose_call(self) -> None:
        """Tell of a call in which somebody killed the node, as one that hangs is."""
        call, self._call = self._call, None
        if call is not None and call.records:
            call.strikes = len(call.records)
            self._tell_strikes(call, "killed in a call: only the strikes of it that are told are counted")

    # -- strikes -----------------------------------------------------------------------------------

    def _strike(self, place: StrikePlace, code: StruckCode) -> int:
        """Strike at a trap; the signal with which the thread goes on."""
        thread, call = self.thread, self._call
        ptrace.go_to(thread.tid, place.inserted.end)
        registers = registers_of(thread)
        registers.put("rcx", code.get(code.words.rcx))
        registers.commit()
        thread.report = StopReport("step")
        if call is None:
            return 0
        standing = StoppedThread(
            self.tracees, thread, self.process, registers, place.instruction, _nothing, _nothing
        )
        try:
            result = self._result(standing, place, call)
        except TargetError:  # it fails by itself before it could be struck
            result = None
        except AddressError:  # so will the access
            result = None
        if result is not None:
            self._note(call, result)
        call.attempts += 1
        if place.operand is None:
            self._await_next(call, code)
        elif self.tally.kept >= STRIKES_KEPT:
            code.put(code.words.mode, STRIKING)
        number = thread.next_signal()
        if number in DEADLY:
            self._end_call()
        return number

    def _result(self, standing: StoppedThread, place: StrikePlace, call: _Call) -> InjectionResult | None:
        if place.operand is not None:
            change = RegisterChange(standing.registers, self.fault, place.operand, place.bits)
            return change.told(standing, change.make(standing))
        draw = schedule.draw_of_strike(self.fault, self.seed, call.invocation, call.attempts)
        return CORRUPTIONS[self.fault.model](standing, self.fault, draw)

    def _note(self, call: _Call, result: InjectionResult) -> None:
        if result.status == "injected":
            call.strikes += 1
            if self.tally.kept >= STRIKES_KEPT:
                return
            self.tally.kept += 1
            call.records.append(self._record(call, result))
            return
        self.tally.kept += self.fault.model == "none"
        if call.failed is None and not self.tally.told:
            call.failed = self._record(call, result)
            self.tally.told = True

    def _record(self, call: _Call, result: InjectionResult) -> InjectionRecord:
        places = self._places
        return record_of(
            result,
            self.fault,
            node=self.node,
            kernel=self.fault.target,
            invocation=call.invocation,
            location=None if places is None else places.at,
            precision="exact",
            trigger=self.fault.trigger,
            pid=self.process.pid,
            tid=self.thread.tid,
            virtual_time_ns=call.now_ns,
            call_end_ns=call.end_ns,
        )

    def _tell_strikes(self, call: _Call, reason: str = "") -> None:
        kept = [strike_of(one) for one in call.records]
        self.tally.told = True
        more = {"strikes": call.strikes, "struck": kept, "reason": reason}
        self.tell(call.records[0].model_copy(update=more))

    def _tell_count(self, call: _Call) -> None:
        """Tell of strikes none of which is told in full."""
        record = self._record(call, InjectionResult("injected"))
        self.tell(record.model_copy(update={"strikes": call.strikes}))

    def _tell_failure(self, call: _Call, reason: str) -> None:
        self.tally.told = True
        self.tell(self._record(call, InjectionResult("failed", reason)))


def _nothing() -> None:
    """Nobody else need stand: nothing but the thread is looked at."""


class UnfollowedError(Exception):
    """A node does what cannot be followed in translation: one line."""
