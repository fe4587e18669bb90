"""The injection of a run, drawn: what was corrupted, where and when, and its bits before and after."""

from __future__ import annotations

from nicegui import ui

from dashboard.analysis.bits import Bit, Field, Word, words
from dashboard.web.charts.flight_style import ALARM, GOLDEN, NEUTRAL, RECOMPUTED
from dashboard.web.components.parts import facts
from injector.tracing.symbols import demangled
from services.models.outcome import InjectionRecord

_COLOURS: dict[Field, str] = {
    "sign": ALARM,
    "exponent": RECOMPUTED,
    "mantissa": GOLDEN,
    "integer": NEUTRAL,
}


def injection_card(record: InjectionRecord) -> None:
    """All that is known of an injection."""
    facts(told(record))
    for word in words(record):
        _draw(word)


def told(record: InjectionRecord) -> dict[str, str]:
    """The injection record as pairs of words."""
    where = f"{record.module or 'code without a file'} at {record.offset:#x}" if record.instruction else ""
    where = ", ".join(filter(None, (demangled(record.symbol), record.line, where)))
    return {
        "Status": record.status,
        "Reason": record.reason,
        "Node": record.node,
        "Kernel": f"{record.kernel}, call {record.invocation}" if record.kernel else "",
        "State": ", ".join(record.state),
        "Message": f"{record.invocation}, point {record.point}" if record.state else "",
        "Virtual time": f"{record.virtual_time_ns / 1e9:.3f} s" if record.virtual_time_ns else "",
        "Instruction": f"{record.instruction}   [{record.instruction_bytes}]" if record.instruction else "",
        "At": where,
        "Struck": _struck(record),
        "Model": record.model,
        "Before": record.before,
        "After": record.after,
        "Read back": record.read_back,
        "Became": record.instruction_after,
        "Held": f"for {record.held_instructions} instructions" if record.held_instructions else "",
        "Strikes": f"{record.strikes}, of which this is the first" if record.strikes else "",
        "Drawn by": f"{record.precision}, {record.probes} probes, {record.resampled} sites passed over",
        "Pause": f"{record.pause_us / 1000:.2f} ms, {record.threads_stopped} threads stood"
        if record.threads_stopped
        else "",
    }


def _struck(record: InjectionRecord) -> str:
    if not record.bits:
        return ""
    bits = (
        f"bit{'s' if len(record.bits) > 1 else ''} {', '.join(map(str, record.bits))} of {record.width_bits}"
    )
    memory = f"memory at {record.address:#x}" if record.address else ""
    what = record.register_name or memory or ("the message" if record.state else "the instruction")
    return f"{record.operand} {what}, {bits}".strip()


def _draw(word: Word) -> None:
    caption = f"Bits {word.low + word.width - 1} to {word.low}: {word.before} became {word.after}"
    ui.label(caption).classes("word-caption")
    with ui.element("div").classes("word").props('role="img"') as drawn:
        drawn.props["aria-label"] = f"{caption}; {word.change}"
        for part in word.parts:
            with ui.element("div").classes("bit-part").style(f"--key: {_COLOURS[part.field]}"):
                with ui.element("div").classes("bit-cells"):
                    for bit in part.bits:
                        _cell(bit)
                ui.label(part.field).classes("part-name")


def _cell(bit: Bit) -> None:
    """Before above, after below; the corrupted ones stand out, not by their colour alone."""
    cell = ui.label(f"{bit.before:d}\n{bit.after:d}").classes("bit corrupted" if bit.corrupted else "bit")
    cell.props["title"] = f"bit {bit.number}: {bit.before:d}, then {bit.after:d}"
