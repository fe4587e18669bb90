"""The record of one injection into a process, for people."""

from __future__ import annotations

import struct
from collections.abc import Iterator

from injector.attach.injection import Aftermath, ProcessInjection
from injector.tracing.symbols import demangled
from services.models.outcome import InjectionRecord

_WIDTH = 10
_FLOATS = {32: (4, "<f"), 64: (8, "<d")}


def card(one: ProcessInjection) -> str:
    """A line for each thing to know."""
    record = one.injection
    if not record.tid:
        return f"{record.status}: process {record.pid} ({one.process}): {record.reason}"
    status = "dry run" if one.dry_run and record.bits else record.status
    head = f"{status}: process {record.pid} ({one.process}), thread {record.tid} ({one.thread})"
    return "\n".join([head, *(f"  {name:{_WIDTH}}{text}" for name, text in _lines(one, record))])


def _lines(one: ProcessInjection, record: InjectionRecord) -> Iterator[tuple[str, str]]:
    if record.instruction:
        yield "at", _place(record)
        yield "executes", f"{record.instruction}   [{record.instruction_bytes}]"
    if record.bits:
        yield "struck", _struck(record)
        yield "before", record.before + _as_number(record, record.before)
        yield "after", record.after + _as_number(record, record.after)
        yield "read back", record.read_back
    if record.instruction_after:
        yield "became", record.instruction_after
    if record.held_instructions:
        yield "held", f"for {record.held_instructions} instructions"
    if record.reason:
        yield "reason", record.reason
    yield "when", _moment(one, record)
    if record.threads_stopped:
        yield "pause", f"{record.pause_us / 1000:.2f} ms, {record.threads_stopped} threads stood"
    yield "then", _end(one.aftermath)


def _place(record: InjectionRecord) -> str:
    where = f"{record.module or 'code without a file'} at {record.offset:#x}"
    return ", ".join(filter(None, (demangled(record.symbol), record.line, where)))


def _struck(record: InjectionRecord) -> str:
    what = record.register_name or (f"memory at {record.address:#x}" if record.operand else "the instruction")
    bits = (
        f"bit{'s' if len(record.bits) > 1 else ''} {', '.join(map(str, record.bits))} of {record.width_bits}"
    )
    return f"{record.operand} {what}, {bits} ({record.model})".strip()


def _as_number(record: InjectionRecord, text: str) -> str:
    """The floating-point number that a value is, if it is just one."""
    if record.element_bits != record.width_bits or record.element_bits not in _FLOATS:
        return ""
    size, form = _FLOATS[record.element_bits]
    return f"   = {struct.unpack(form, int(text, 16).to_bytes(size, 'little'))[0]:.10g}"


def _moment(one: ProcessInjection, record: InjectionRecord) -> str:
    parts: list[str] = [record.precision]
    if one.step is not None:
        of = f" of {one.instructions}" if one.instructions is not None else ""
        parts.append(f"instruction {one.step}{of}")
    if one.hit is not None:
        parts.append(f"pass {one.hit} through it, of {one.instructions} instructions")
    if one.cpu_ns is not None:
        parts.append(f"after {one.cpu_ns / 1e6:.3f} ms of processor time")
    if one.function:
        parts.append(f"of call {one.call} of {one.function}")
    if one.rehearsals:
        parts.append(f"{one.rehearsals} calls rehearsed")
    if one.missed:
        parts.append(f"{one.missed} calls over before what was drawn for them")
    if one.uncounted:
        parts.append(f"not counted: {one.uncounted}")
    if record.resampled:
        parts.append(f"{record.resampled} passed over")
    return ", ".join(parts)


def _end(end: Aftermath) -> str:
    if end.result == "lives":
        return f"it lives, {end.watched_s:g} s later" if end.watched_s else "not watched"
    if end.result == "stopped":
        return "it is stopped, as it was before"
    if end.result == "ended":
        return "it ended, nobody knows how"
    how = f"killed by {end.signal}" if end.result == "killed" else f"exited with status {end.exit_status}"
    return f"{how} after {end.after_s:g} s"
