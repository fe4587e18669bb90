"""How the fault of a run propagated: when and how far each topic deviated from the golden twin."""

from __future__ import annotations

import numpy as np
from nicegui import ui

from dashboard.analysis.propagation import Picture
from dashboard.web.charts.charts import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILION
from dashboard.web.charts.curves import Chart, Curve
from dashboard.web.components.parts import table

FIELDS = 3
"""Of a message, that are named; the others are counted."""

_COLOURS = (VERMILION, BLUE, ORANGE, GREEN, PURPLE, SKY)


def propagation_view(seen: Picture) -> None:
    """Draw a table and a chart of the topics that deviated, in the order in which they did."""
    found = seen.propagation
    if not found.topics:
        ui.label("No topic left the golden twin's: every message is the same to the bit.")
        return
    delay = found.delay_ns
    reached = "It never reached the flight command."
    if delay is not None:
        reached = f"It reached the flight command {delay / 1e9:.3f} s after the injection."
    ui.label(reached)
    rows = [
        (
            one.topic,
            one.stage,
            f"{one.at_ns / 1e9:.3f}",
            str(one.tick),
            ", ".join(one.causes) or "-",
            _fields(one.fields),
            _size(one.first, one.unit),
            _size(one.largest, one.unit),
            _size(one.last, one.unit),
        )
        for one in found.topics
    ]
    heads = ("topic", "from", "strayed at (s)", "tick", "because of", "fields", "first", "largest", "last")
    table("How the fault propagated", heads, rows, ("strayed at (s)", "tick", "first", "largest", "last"))
    if seen.growth:
        _growth(seen)
    if found.same:
        ui.label(f"The twin's to the bit: {', '.join(found.same)}.").classes("note")


def _fields(names: list[str]) -> str:
    if not names:
        return "its time, or that it is there"
    more = f" and {len(names) - FIELDS} more" if len(names) > FIELDS else ""
    return ", ".join(names[:FIELDS]) + more


def _size(deviation: float | None, unit: str) -> str:
    if deviation is None:
        return "-"
    return f"{deviation:.0f} {_unit(unit)}" if deviation >= 1000 else f"{deviation:.3g} {_unit(unit)}"


def _unit(name: str) -> str:
    return name.replace("^2", "²")


def _growth(seen: Picture) -> None:
    """How far each topic was from the twin's; zeros, which a logarithm has no place for, are gaps."""
    curves = []
    for number, one in enumerate(seen.growth):
        told = np.array(one.deviation, dtype=np.float64)
        told[~(told > 0)] = np.nan
        colour, dashed = _COLOURS[number % len(_COLOURS)], number >= len(_COLOURS)
        curves.append(
            Curve(f"{one.topic} ({_unit(one.unit)})", colour, np.array(one.time_s), told, dashed=dashed)
        )
    with ui.element("div").classes("panel"):
        Chart("deviation, each in its own unit", curves, logarithmic=True)
