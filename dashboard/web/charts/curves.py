"""Charts of what changes over a flight's time, with its moments marked."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from nicegui import ui
from numpy.typing import NDArray

from dashboard.web.charts.charts import TEXT
from dashboard.web.charts.flight_style import NEUTRAL

Floats = NDArray[np.float64]

MOST_POINTS = 1500
"""Of one curve: what lies between is thinned out, extremes are kept."""

MOST_LABELS = 8
"""Of a logarithmic axis, besides the lowest."""

_POWER = "value => value >= 0.01 && value < 1000 ? String(value) : value.toExponential(0)"
"""How numbers are written on a logarithmic axis."""


@dataclass(frozen=True, slots=True)
class Curve:
    """``values`` (n,) at ``times_s`` (n,); a NaN is a gap."""

    name: str
    colour: str
    times_s: Floats
    values: Floats
    dashed: bool = False


@dataclass(frozen=True, slots=True)
class Moment:
    """A time that is marked on a chart."""

    name: str
    colour: str
    time_s: float
    side: Literal["insideEndTop", "insideEndBottom"] = "insideEndTop"


class Chart:
    """One quantity over time, up to ``end_s``; ``quantity`` with its unit, as on the axis."""

    def __init__(
        self,
        quantity: str,
        curves: Sequence[Curve],
        moments: Sequence[Moment] = (),
        *,
        end_s: float | None = None,
        logarithmic: bool = False,
    ) -> None:
        options = _options(quantity, curves, moments)
        if end_s is not None:
            options["xAxis"]["max"] = math.ceil(end_s)
            options["xAxis"]["axisLabel"] = {**options["xAxis"]["axisLabel"], "showMaxLabel": False}
        if logarithmic:
            options["yAxis"] |= {"type": "log", **_decades(curves)}
            options["yAxis"]["axisLabel"] = {**options["yAxis"]["axisLabel"], ":formatter": _POWER}
        self.element = ui.echart(options).classes("curve")
        self.element.props('role="img"').props["aria-label"] = f"{quantity} over time"

    def show(self, curves: Sequence[Curve]) -> None:
        """Draw other values; as many curves as there were."""
        for drawn, curve in zip(self.element.options["series"], curves, strict=False):
            drawn["data"] = pairs(curve)

    def point_at(self, time_s: float) -> None:
        """Move the line that says which moment is looked at."""
        line = {"silent": True, "symbol": "none", "data": [{"xAxis": time_s}]}
        self.element.run_chart_method("setOption", {"series": [{"id": "now", "markLine": line}]})


def _decades(curves: Sequence[Curve]) -> dict[str, float]:
    """Ends and base of a logarithmic axis around what is drawn; at each power of the base stands a label.

    ECharts alone labels every decade, or of ten and more every tenth.
    """
    drawn = np.concatenate([curve.values for curve in curves])
    drawn = drawn[np.isfinite(drawn) & (drawn > 0)]
    if not len(drawn):
        return {}
    low, high = math.floor(math.log10(drawn.min())), math.ceil(math.log10(drawn.max()))
    step = max(1, math.ceil((high - low) / MOST_LABELS))
    first, last = low // step, max(-(-high // step), low // step + 1)
    return {"min": 10.0 ** (step * first), "max": 10.0 ** (step * last), "logBase": 10.0**step}


def pairs(curve: Curve) -> list[tuple[float, float | None]]:
    """Time and value, thinned out; None where there is no finite value."""
    times, values = thinned(curve.times_s, curve.values)
    return [
        (round(float(time), 3), float(f"{value:.6g}") if np.isfinite(value) else None)
        for time, value in zip(times, values, strict=True)
    ]


def thinned(times: Floats, values: Floats) -> tuple[Floats, Floats]:
    """At most :data:`MOST_POINTS`: of each stretch of time the smallest and the largest value."""
    if len(times) <= MOST_POINTS:
        return times, values
    stretches = np.array_split(np.arange(len(times)), MOST_POINTS // 2)
    kept = [
        index
        for stretch in stretches
        for index in sorted(
            {
                int(stretch[np.argmin(np.nan_to_num(values[stretch], nan=np.inf))]),
                int(stretch[np.argmax(np.nan_to_num(values[stretch], nan=-np.inf))]),
            }
        )
    ]
    return times[kept], values[kept]


def _options(quantity: str, curves: Sequence[Curve], moments: Sequence[Moment]) -> dict[str, Any]:
    text = {":color": TEXT}
    axis = {
        "type": "value",
        "nameTextStyle": text,
        "axisLabel": text,
        "splitLine": {"lineStyle": {"color": "#88888833"}},
        "axisLine": {"lineStyle": {"color": NEUTRAL}},
    }
    return {
        "animation": False,
        "grid": {"left": 56, "right": 16, "top": 48, "bottom": 42},
        "legend": {
            "type": "scroll",
            "top": 0,
            "left": 56,
            "right": 0,
            "itemStyle": {"opacity": 0},  # the line alone, dashed where it is
            "textStyle": text,
            "pageTextStyle": text,
            "data": [curve.name for curve in curves],
        },
        "tooltip": {"trigger": "axis"},
        "xAxis": {**axis, "name": "time (s)", "nameLocation": "middle", "nameGap": 26, "min": 0},
        "yAxis": {**axis, "name": quantity, "scale": True, "nameTextStyle": {**text, "align": "left"}},
        "series": [
            *map(_series, curves),
            _lines("moments", [_mark(moment) for moment in moments]),
            _lines("now", []),
        ],
    }


def _series(curve: Curve) -> dict[str, Any]:
    return {
        "type": "line",
        "name": curve.name,
        "data": pairs(curve),
        "showSymbol": False,
        "step": "end",
        "z": 3 if curve.dashed else 2,
        "color": curve.colour,
        "lineStyle": {"width": 1.6, "type": "dashed" if curve.dashed else "solid"},
    }


def _lines(identity: str, marks: list[dict[str, Any]]) -> dict[str, Any]:
    """A series of vertical lines alone."""
    return {
        "id": identity,
        "type": "line",
        "data": [],
        "markLine": {
            "silent": True,
            "symbol": "none",
            "lineStyle": {"color": NEUTRAL, "type": "solid", "width": 1},
            "label": {"show": False},
            "data": marks,
        },
    }


def _mark(moment: Moment) -> dict[str, Any]:
    return {
        "xAxis": round(moment.time_s, 3),
        "lineStyle": {"color": moment.colour, "type": "dashed", "width": 1.5},
        "label": {
            "show": bool(moment.name),
            "formatter": moment.name,
            ":color": TEXT,
            "fontSize": 11,
            "position": moment.side,
        },
    }
