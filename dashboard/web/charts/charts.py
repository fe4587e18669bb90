"""Options of the charts. Colours are Okabe and Ito's, which colour-blind people can tell apart.

Names that people typed are drawn as text on the canvas, tooltips too: never as markup.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, VERMILION, PURPLE = (
    "#8a8a8a",
    "#E69F00",
    "#56B4E9",
    "#009E73",
    "#F0E442",
    "#0072B2",
    "#D55E00",
    "#CC79A7",
)
"""The black is a grey that shows on white and on black."""

RESULT_COLOURS: Mapping[str, str] = {
    "success": GREEN,
    "collision": VERMILION,
    "no_path": ORANGE,
    "timeout": PURPLE,
    "stack_failure": BLACK,
    "golden": SKY,
    "benign": GREEN,
    "sdc": ORANGE,
    "unpaired": YELLOW,
    "crash": VERMILION,
    "detected": BLUE,
    "hang": PURPLE,
}
"""Of missions and of nodes."""

SHARE_SCALE = ("#fdf6dc", "#f6c667", "#e8833a", "#b13c2e", "#5b1a3a")
"""From none to all; darker is more also without colours."""

ROW_PX = 30
Options = dict[str, Any]
TEXT = "getComputedStyle(document.body).color"
_POINT = f"(document.body.classList.contains('body--dark') ? '{SKY}' : '{BLUE}')"
_FONT = "Roboto, sans-serif"


def height(rows: int) -> str:
    """Of a chart with so many rows."""
    return f"height: {ROW_PX * max(rows, 2) + 90}px"


def base(about: str) -> Options:
    """What all charts have in common; ``about`` is for those who cannot see it."""
    return {
        "animation": False,
        "aria": {"enabled": True, "label": {"description": about}},
        ":textStyle": f"({{color: {TEXT}, fontFamily: '{_FONT}'}})",
        "tooltip": {"renderMode": "richText", "confine": True, "formatter": "{b}"},
        "grid": {"left": 8, "right": 20, "top": 30, "bottom": 30, "containLabel": True},
    }


def axis(kind: str, **more: Any) -> Options:
    """An axis whose text is as dark as the page's."""
    label = {":color": TEXT, **more.pop("axisLabel", {})}
    return {"type": kind, "axisLabel": label, ":nameTextStyle": f"({{color: {TEXT}}})", **more}


def names(labels: Sequence[str], **more: Any) -> Options:
    """An axis of names, the first on top."""
    shortened = {"width": 150, "overflow": "break", "lineHeight": 13}
    return axis("category", data=list(labels), inverse=True, axisLabel=shortened, **more)


def legend(**more: Any) -> Options:
    """The ECharts options of a legend above the chart."""
    return {"top": 0, ":textStyle": f"({{color: {TEXT}}})", "type": "scroll", **more}


def measure(name: str, **more: Any) -> Options:
    """A horizontal axis of numbers with its unit below."""
    lines = {"lineStyle": {"color": "#8888", "opacity": 0.35}}
    below = {"onZero": False}
    return axis(
        "value", name=name, nameLocation="middle", nameGap=26, splitLine=lines, axisLine=below, **more
    )


_INTERVAL = """
(params, api) => {
  const y = api.value(2), low = api.coord([api.value(0), y]), high = api.coord([api.value(1), y]);
  const style = {stroke: COLOUR, lineWidth: 2};
  const line = (x1, y1, x2, y2) => ({type: 'line', shape: {x1, y1, x2, y2}, style});
  return {type: 'group', children: [
    line(low[0], low[1], high[0], high[1]),
    line(low[0], low[1] - 5, low[0], low[1] + 5),
    line(high[0], high[1] - 5, high[0], high[1] + 5),
  ]};
}
""".replace("COLOUR", TEXT)


def _intervals(data: list[Options]) -> Options:
    """Whiskers over points and bars; values are (low, high, row)."""
    return {
        "type": "custom",
        ":renderItem": _INTERVAL,
        "data": data,
        "encode": {"x": [0, 1], "y": 2},
        "z": 5,
    }


class ChartPart(NamedTuple):
    """A part of a whole, with its interval as parts of one."""

    label: str
    number: int
    total: int
    low: float
    high: float


def shares(rows: Sequence[ChartPart], colour: str, name: str, about: str) -> Options:
    """Bars of parts of a whole, in per cent, with their intervals."""

    def told(row: ChartPart) -> str:
        return f"{row.label}: {row.number} of {row.total}, {100 * row.low:.0f} to {100 * row.high:.0f} %"

    bars = [{"name": told(row), "value": round(100 * row[1] / row[2], 2) if row[2] else None} for row in rows]
    intervals = [
        {"name": told(row), "value": [100 * row[3], 100 * row[4], i]} for i, row in enumerate(rows) if row[2]
    ]
    return base(about) | {
        "xAxis": measure(name, min=0, max=100),
        "yAxis": names([row.label for row in rows]),
        "series": [
            {"type": "bar", "data": bars, "itemStyle": {"color": colour}, "barWidth": "55%"},
            _intervals(intervals),
        ],
    }


class ChartChange(NamedTuple):
    """A difference with its interval; None where it is not known."""

    label: str
    value: float | None
    low: float
    high: float


def forest(rows: Sequence[ChartChange], name: str, about: str) -> Options:
    """Differences as points with their intervals, beside a line at none."""

    def told(row: ChartChange) -> str:
        return f"{row.label}: {row.value:+.1f}, {row.low:+.1f} to {row.high:+.1f}"

    known = [(i, row) for i, row in enumerate(rows) if row.value is not None]
    points = [{"name": told(row), "value": [row.value, i]} for i, row in known]
    intervals = [{"name": told(row), "value": [row.low, row.high, i]} for i, row in known]
    none = {"silent": True, "symbol": "none", "lineStyle": {"color": BLACK}, "data": [{"xAxis": 0}]}
    return base(about) | {
        "xAxis": measure(name, scale=True),
        "yAxis": names([row.label for row in rows]),
        "series": [
            {
                "type": "scatter",
                "symbolSize": 11,
                ":itemStyle": f"({{color: {_POINT}}})",
                "data": points,
                "markLine": none | {"label": {"show": False}},
            },
            _intervals(intervals),
        ],
    }


class ChartPair(NamedTuple):
    """A number of the paper's and ours; None where we have none yet, or no interval of it."""

    label: str
    paper: float
    ours: float | None
    interval: tuple[float, float] | None


def beside(rows: Sequence[ChartPair], name: str, about: str) -> Options:
    """The paper's numbers as diamonds, ours as circles with their intervals, a row each."""
    papers = [
        {"name": f"{row.label}: paper {row.paper:.1f}", "value": [row.paper, i]} for i, row in enumerate(rows)
    ]
    ours = [
        {"name": f"{row.label}: ours {row.ours:.1f}", "value": [row.ours, i]}
        for i, row in enumerate(rows)
        if row.ours is not None
    ]
    intervals = [
        {
            "name": f"{row.label}: ours {row.interval[0]:.1f} to {row.interval[1]:.1f}",
            "value": [*row.interval, i],
        }
        for i, row in enumerate(rows)
        if row.interval is not None
    ]
    whole = {"width": 190, "overflow": "break", "lineHeight": 13}
    return base(about) | {
        "legend": legend(data=["paper", "ours"]),
        "xAxis": measure(name, scale=True),
        "yAxis": axis("category", data=[row.label for row in rows], inverse=True, axisLabel=whole),
        "series": [
            {
                "type": "scatter",
                "name": "paper",
                "symbol": "diamond",
                "symbolSize": 14,
                "itemStyle": {"color": ORANGE},
                "data": papers,
            },
            {
                "type": "scatter",
                "name": "ours",
                "symbolSize": 11,
                ":itemStyle": f"({{color: {_POINT}}})",
                "data": ours,
            },
            _intervals(intervals),
        ],
    }


def stacked(labels: Sequence[str], counts: Sequence[Mapping[str, int]], name: str, about: str) -> Options:
    """What became of flights: parts of each row in per cent, one colour a result."""
    kinds = [kind for kind in RESULT_COLOURS if any(one.get(kind) for one in counts)]
    totals = [sum(one.values()) for one in counts]

    def part(row: int, kind: str) -> Options:
        count, total = counts[row].get(kind, 0), totals[row]
        told = f"{labels[row]}: {kind.replace('_', ' ')} {count} of {total}"
        return {"name": told, "value": round(100 * count / total, 2) if total else 0}

    series = [
        {
            "type": "bar",
            "stack": "all",
            "name": kind.replace("_", " "),
            "itemStyle": {"color": RESULT_COLOURS[kind], "borderColor": "#8884", "borderWidth": 1},
            "barWidth": "60%",
            "data": [part(row, kind) for row in range(len(labels))],
        }
        for kind in kinds
    ]
    return base(about) | {
        "legend": legend(),
        "xAxis": measure(name, min=0, max=100),
        "yAxis": names(labels),
        "series": series,
    }


class ChartPoint(NamedTuple):
    """A flight in a row of a chart: its value, whether it succeeded, what to tell of it, its number."""

    row: int
    value: float
    success: bool
    told: str
    run: int


def _scattered(row: int, number: int) -> float:
    """A height in the row; the golden ratio spreads them evenly, and the same way each time."""
    return round(row + (number * 0.618) % 1 * 0.56 - 0.28, 3)


def boxes(
    labels: Sequence[str],
    fives: Sequence[Sequence[float] | None],
    dots: Sequence[ChartPoint],
    name: str,
    about: str,
) -> Options:
    """Boxes (smallest, quartiles, largest) and dots, scattered in height; triangles are failures."""

    def scattered(success: bool) -> list[Options]:
        kept = [(i, dot) for i, dot in enumerate(dots) if dot.success == success]
        return [
            {"name": dot.told, "value": [round(dot.value, 3), _scattered(dot.row, i)], "run": dot.run}
            for i, dot in kept
        ]

    def told(label: str, five: Sequence[float]) -> str:
        low, first, median, third, high = five
        return (
            f"{label}: median {median:.1f}, quartiles {first:.1f} to {third:.1f}, all {low:.1f} to {high:.1f}"
        )

    boxed: list[Options] = [
        {"name": told(label, five), "value": [round(one, 3) for one in five]} if five else {"value": []}
        for label, five in zip(labels, fives, strict=True)
    ]
    second = {"type": "value", "min": -0.5, "max": len(labels) - 0.5, "inverse": True, "show": False}
    style = {"color": "#8882", ":borderColor": TEXT, "borderWidth": 1.5}
    point = {"type": "scatter", "yAxisIndex": 1, "cursor": "pointer"}
    return base(about) | {
        "legend": legend(data=["success", "failure"]),
        "xAxis": measure(name, scale=True),
        "yAxis": [names(labels), second],
        "series": [
            {"type": "boxplot", "name": "successful flights", "data": boxed, "itemStyle": style},
            point
            | {
                "name": "success",
                "symbolSize": 6,
                ":itemStyle": f"({{color: {_POINT}, opacity: 0.65}})",
                "data": scattered(success=True),
            },
            point
            | {
                "name": "failure",
                "symbol": "triangle",
                "symbolSize": 9,
                "itemStyle": {"color": VERMILION, "opacity": 0.85},
                "data": scattered(success=False),
            },
        ],
    }


def heat_map(
    across: Sequence[str],
    down: Sequence[str],
    found: Mapping[tuple[str, str], tuple[int, int]],
    name: str,
    about: str,
) -> Options:
    """A part of the injected, by column and row; in each field how many of how many. ``name``: of what."""

    def field(x: int, y: int) -> Options:
        failed, injected = found[across[x], down[y]]
        told = f"{down[y]}, bits {across[x]}: {failed} of {injected} {name}"
        colour = "#000" if failed < 0.5 * injected else "#fff"
        label = {"show": True, "formatter": f"{failed}/{injected}", "color": colour}
        return {"name": told, "value": [x, y, round(100 * failed / injected, 1)], "label": label}

    fields = [(x, y) for y in range(len(down)) for x in range(len(across))]
    data = [field(x, y) for x, y in fields if (across[x], down[y]) in found]
    scale = {
        "min": 0,
        "max": 100,
        "calculable": False,
        "orient": "horizontal",
        "top": 0,
        "left": "center",
        "text": [f"100 % {name}", "0 %"],
        ":textStyle": f"({{color: {TEXT}}})",
        "inRange": {"color": list(SHARE_SCALE)},
        "itemHeight": 120,
    }
    rotated = {"interval": 0, "rotate": 60 if len(across) > 10 else 0}
    lowest = {"left": 8, "right": 20, "top": 50, "bottom": 30, "containLabel": True}
    return base(about) | {
        "grid": lowest,
        "xAxis": axis(
            "category",
            data=list(across),
            name="bits",
            nameLocation="middle",
            nameGap=46 if len(across) > 10 else 28,
            axisLabel=rotated,
        ),
        "yAxis": names(down),
        "visualMap": scale,
        "series": [
            {"type": "heatmap", "data": data, "itemStyle": {"borderColor": "#8886", "borderWidth": 1}}
        ],
    }
