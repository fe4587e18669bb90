"""Plots for notebooks and papers, with matplotlib (``zenfi[plot]``): path, propagation, quality of flight.

Each returns a figure, which a notebook shows and ``figure.savefig`` writes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from io import BytesIO
from typing import TYPE_CHECKING, Any

from dashboard.analysis.extras import installed
from dashboard.analysis.kernel_study import OutcomeShare
from dashboard.analysis.plan import Rectangle, shapes
from dashboard.analysis.propagation import picture
from dashboard.analysis.recordings_reader import FlightRecording
from dashboard.analysis.tables import cell_name
from dashboard.campaigns.results.summary import CellSummary
from sim.world import make_world

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FLOWN, TWIN, FAULT = "#c0392b", "#4a6fa5", "#e67e22"
"""Colours of a flight, its golden twin, and the moment of the fault."""

OUTCOME_COLOURS = {
    "benign": "#9db4ab",
    "sdc": "#e67e22",
    "detected": "#4a6fa5",
    "crash": "#c0392b",
    "hang": "#5d4157",
}
"""Of what became of a struck kernel or program."""

_FEW = 50
"""Fewer points are marked, each."""


def path(run: FlightRecording, twin: FlightRecording | None = None) -> Figure:
    """The path of a flight from above, in its world, and its height over time; with its golden twin's.

    :raises BadSpecError: if matplotlib is not installed, or the file does not say what was flown.
    """
    figure = _figure(10.0, 3.6, run.spec.world_name)
    above, beside = figure.subplots(1, 2, width_ratios=(3, 2))
    _draw_world(above, run)
    above.set(xlabel="x, m", ylabel="y, m", title="from above", aspect="equal")
    beside.set(xlabel="time, s", ylabel="height, m", title="height")
    for one, name, colour in ((twin, "golden twin", TWIN), (run, "flight", FLOWN)):
        if one is None:
            continue
        odometry = one.table("odometry")
        x, y, z = (odometry[f"pose.pose.position.{axis}"] for axis in "xyz")
        above.plot(x, y, color=colour, label=name)
        beside.plot(odometry["ready_ns"] / 1e9, z, color=colour, label=name)
    _mark_fault(beside, run)
    beside.legend()
    return figure


def growth(run: FlightRecording, twin: FlightRecording) -> Figure:
    """How far each topic of a flight was from its golden twin's over time, in the topic's own unit.

    :raises BadSpecError: if ``twin`` is not its golden twin, or matplotlib is not installed.
    """
    grown = picture(run, twin).growth
    figure = _figure(8.0, 1.2 + 1.2 * max(len(grown), 1), "deviation from the golden twin")
    axes = figure.subplots(max(len(grown), 1), 1, sharex=True, squeeze=False)[:, 0]
    for axis, one in zip(axes, grown, strict=False):
        told = [(at, value) for at, value in zip(one.time_s, one.deviation, strict=True) if value is not None]
        marker = "." if len(told) < _FEW else ""
        axis.plot([at for at, _ in told], [value for _, value in told], color=FLOWN, marker=marker)
        axis.set_ylabel(f"{one.topic}\n{one.unit}", rotation=0, ha="right", va="center")
        axis.set_yscale("symlog", linthresh=1e-3)
        axis.set_ylim(bottom=0.0)
        _mark_fault(axis, run)
    if not grown:
        axes[0].text(0.5, 0.5, "no topic strayed", ha="center", va="center")
    axes[-1].set_xlabel("time, s")
    return figure


def quality(title: str, lines: Sequence[CellSummary]) -> Figure:
    """Success, and flight time of those that arrived, of each cell of a campaign, with 95 % intervals.

    :raises BadSpecError: if matplotlib is not installed.
    """
    flown = [line for line in lines if line.runs > line.failed_to_fly]
    names = [cell_name(line, len({one.world for one in lines}) > 1) for line in flown]
    figure = _figure(10.0, 1.4 + 0.32 * max(len(flown), 1), title)
    success, time = figure.subplots(1, 2, sharey=True)
    for place, line in enumerate(flown):
        share = line.successes / (line.runs - line.failed_to_fly)
        _interval(success, place, 100 * share, 100 * line.success_low, 100 * line.success_high)
        if line.flight_time_s is not None:
            _interval(time, place, line.flight_time_s, line.flight_time_low_s, line.flight_time_high_s)
    rows = {"ylim": (max(len(names), 1) - 0.5, -0.5), "yticks": range(len(names)), "yticklabels": names}
    success.set(xlabel="success, %", xlim=(-3, 103), **rows)
    time.set(xlabel="flight time of successes, median, s")
    for axis in (success, time):
        axis.grid(axis="x", alpha=0.3)
    return figure


def outcomes(title: str, found: Mapping[str, Mapping[str, OutcomeShare]]) -> Figure:
    """Bars of what became of the faults in each kernel or program, in per cent of the injected.

    :raises BadSpecError: if matplotlib is not installed.
    """
    figure = _figure(8.0, 1.6 + 0.4 * max(len(found), 1), title)
    axis = figure.subplots()
    begins = [0.0] * len(found)
    for name, colour in OUTCOME_COLOURS.items():
        counts = [shares[name].count if name in shares else 0 for shares in found.values()]
        totals = [max(sum(one.count for one in shares.values()), 1) for shares in found.values()]
        widths = [100 * count / total for count, total in zip(counts, totals, strict=True)]
        if any(counts):
            axis.barh(range(len(found)), widths, left=begins, color=colour, label=name)
        begins = [begin + width for begin, width in zip(begins, widths, strict=True)]
    axis.set(xlim=(0, 100), yticks=range(len(found)), yticklabels=list(found), xlabel="of the injected, %")
    axis.invert_yaxis()
    if found:
        figure.legend(loc="outside lower center", ncols=len(OUTCOME_COLOURS))
    return figure


def lines(
    title: str, across: str, upwards: str, found: Mapping[str, Sequence[tuple[float, float | None]]]
) -> Figure:
    """Lines of one quantity over another, by name; each ends where there is no value (None).

    :raises BadSpecError: if matplotlib is not installed.
    """
    figure = _figure(7.0, 4.0, title)
    axis = figure.subplots()
    for name, points in found.items():
        known = [(x, y) for x, y in points if y is not None]
        axis.plot([x for x, _ in known], [y for _, y in known], label=name)
    axis.set(xlabel=across, ylabel=upwards)
    axis.legend()
    return figure


def heat_map(
    title: str,
    down: Sequence[str],
    across: Sequence[str],
    found: Mapping[tuple[int, int], tuple[float, str]],
) -> Figure:
    """Fields by row and column, coloured by a number of per cent, with what is written in them.

    :raises BadSpecError: if matplotlib is not installed.
    """
    figure = _figure(2.5 + 1.2 * len(across), 1.2 + 0.3 * max(len(down), 1), title)
    axis = figure.subplots()
    values = [
        [found.get((row, column), (float("nan"), ""))[0] for column in range(len(across))]
        for row in range(len(down))
    ]
    axis.imshow(values or [[float("nan")]], cmap="OrRd", vmin=0, vmax=100, aspect="auto")
    for (row, column), (value, text) in found.items():
        axis.text(
            column, row, text, ha="center", va="center", color="white" if value > 60 else "black", fontsize=8
        )
    axis.set(
        xticks=range(len(across)), xticklabels=list(across), yticks=range(len(down)), yticklabels=list(down)
    )
    return figure


def rates(rows: Sequence[tuple[str, float, float]], target: float | None) -> Figure:
    """Names, rates and their upper bounds, per hour, on a logarithmic axis; with the rate to stay below.

    :raises BadSpecError: if matplotlib is not installed.
    """
    figure = _figure(8.0, 1.2 + 0.35 * len(rows), "failures per flight hour: estimate, and its bound")
    axis = figure.subplots()
    least = min(bound for _, _, bound in rows) / 100
    for place, (_, rate, bound) in enumerate(rows):
        axis.plot([max(rate, least), bound], [place, place], color=TWIN, linewidth=2)
        axis.plot([bound], [place], "|", color=TWIN, markersize=12)
        if rate:
            axis.plot([rate], [place], "o", color=FLOWN)
    if target is not None:
        axis.axvline(target, color=FAULT, linestyle=":", label="target")
        axis.legend()
    names = [name for name, _, _ in rows]
    axis.set(xscale="log", ylim=(len(rows) - 0.5, -0.5), yticks=range(len(rows)), yticklabels=names)
    axis.set_xlabel("failures per flight hour")
    axis.grid(axis="x", alpha=0.3)
    return figure


def trade_off(
    others: Sequence[tuple[float, float]],
    best: Sequence[tuple[str, float, float, float]],
    target: float | None,
) -> Figure:
    """Designs by flight time that they add (a part) and the bound of their failures per flight hour.

    ``best`` are those on the front: name, flight time, bound, and the mass in kg that they add. ``others``
    are all: flight time and bound.

    :raises BadSpecError: if matplotlib is not installed.
    """
    figure = _figure(8.0, 4.5, "designs: harm that is left, and what they cost")
    axis = figure.subplots()
    axis.plot([100 * time for time, _ in others], [bound for _, bound in others], ".", color="#b8c2cc")
    for name, time, bound, mass_kg in best:
        axis.plot([100 * time], [bound], "s" if mass_kg else "o", color=FLOWN)
        axis.annotate(name, (100 * time, bound), textcoords="offset points", xytext=(5, 4), fontsize=7)
    if target is not None:
        axis.axhline(target, color=FAULT, linestyle=":", label="target")
        axis.legend()
    if any(bound > 0 for _, bound in others):
        axis.set_yscale("log", nonpositive="clip")
    axis.set(xlabel="flight time added, %", ylabel="failures per flight hour, bound")
    axis.grid(alpha=0.3)
    return figure


def svg(figure: Figure) -> str:
    """A figure as SVG, the same bytes for the same figure."""
    matplotlib: Any = installed("matplotlib", "plot")
    drawn = BytesIO()
    # Names of parts are random otherwise, and the file tells when it was made.
    with matplotlib.rc_context({"svg.hashsalt": "zenfi"}):
        figure.savefig(drawn, format="svg", metadata={"Date": None})
    return drawn.getvalue().decode()


def _figure(width: float, height: float, title: str) -> Figure:
    """A figure of so many inches that belongs to nobody: pyplot would keep every one."""
    made = _shown_figure()(figsize=(width, height), layout="constrained")
    made.suptitle(title)
    return made


@cache
def _shown_figure() -> type[Figure]:
    """Figures that notebooks show: those of matplotlib are shown only where pyplot made them."""
    plain: type[Figure] = installed("matplotlib.figure", "plot").Figure

    class ShownFigure(plain):  # type: ignore[misc,valid-type]
        def _repr_png_(self) -> bytes:
            drawn = BytesIO()
            self.savefig(drawn, format="png", dpi=60)
            return drawn.getvalue()

    return ShownFigure


def _interval(axis: Axes, place: int, value: float, low: float | None, high: float | None) -> None:
    if low is not None and high is not None:
        axis.plot([low, high], [place, place], color=TWIN, linewidth=2)
    axis.plot([value], [place], "o", color=FLOWN)


def _draw_world(axis: Axes, run: FlightRecording) -> None:
    patches: Any = installed("matplotlib.patches", "plot")
    world = make_world(run.spec.world, run.spec.seed)
    for shape in shapes(world):
        colour = f"#{shape.colour:06x}"
        if isinstance(shape, Rectangle):
            width, height = shape.x1 - shape.x0, shape.y1 - shape.y0
            axis.add_patch(patches.Rectangle((shape.x0, shape.y0), width, height, color=colour, linewidth=0))
        else:
            axis.add_patch(patches.Circle((shape.x, shape.y), shape.radius, color=colour, linewidth=0))
    axis.autoscale_view()  # the ground is among the shapes


def _mark_fault(axis: Axes, run: FlightRecording) -> None:
    record = run.injection
    if record is not None and record.status == "injected":
        axis.axvline(record.virtual_time_ns / 1e9, color=FAULT, linestyle=":", label="fault")
