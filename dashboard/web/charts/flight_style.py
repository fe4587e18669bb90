"""Colours and styles of the pages that show flights."""

from __future__ import annotations

from pathlib import Path

from nicegui import ui

from dashboard.web.charts.charts import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILION

GOLDEN, INJECTED, RECOMPUTED, ALARM, STRUCK = BLUE, VERMILION, GREEN, ORANGE, PURPLE
WITH_DETECTOR = SKY
NEUTRAL = "#8a9099"
"""Of texts on charts: legible on light and on dark."""


def install() -> None:
    """Styles of the pages that show flights."""
    ui.add_css(Path(__file__).parents[1] / "flight.css", shared=True)
