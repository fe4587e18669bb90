"""What was corrupted, and whether the missions failed: bits against targets, and groups of instructions."""

from __future__ import annotations

from collections.abc import Sequence

from nicegui import ui

from dashboard.analysis.kernel_study import WAYS
from dashboard.web.charts import charts
from dashboard.web.components.findings import FAILURES, FindingsChart, InjectionFindings
from dashboard.web.components.frame import nothing
from dashboard.web.components.quality_tables import Row, table


class Breakdown:
    """Heat map and table; :meth:`show` brings them up to date."""

    def __init__(self) -> None:
        self._injections = InjectionFindings()
        with ui.column().classes("section") as self._none:
            nothing(
                "No fault was injected yet.", "Flights with a fault appear here as soon as they are flown."
            )
        with ui.column().classes("section") as self._some:
            ui.label("Injected flights by what was corrupted, and in which bits").classes("caption")
            self._failure = ui.toggle(list(FAILURES), value="missions failed", on_change=self._show_heat)
            self._failure.props('no-caps unelevated aria-label="What went wrong"').classes("ways-toggle")
            with ui.element("div").classes("sideways"):
                self._heat = ui.echart({}).classes("chart heat")
            with ui.row().classes("toolbar"):
                ui.label("The same by")
                ways = [way for way in WAYS if way != "line"]  # of flights none is looked up
                self._way = ui.toggle(ways, value="register", on_change=self._regroup)
                self._way.props('no-caps unelevated aria-label="Divide by"').classes("ways-toggle")
            self._table = table(
                (
                    ("name", "what"),
                    ("injected", "injected"),
                    *((name, f"{name}, % (95 %)") for name in FAILURES),
                )
            )
            self._table.classes("narrow")
            self._more = ui.label().classes("note")

    def show(self, injections: InjectionFindings) -> None:
        """Show the injected flights so far."""
        self._injections = injections
        self._none.set_visibility(not injections.flights)
        self._some.set_visibility(bool(injections.flights))
        if injections.flights:
            self._show_heat()
            self._regroup()

    def _show_heat(self) -> None:
        heat = self._injections.heat(str(self._failure.value))
        if heat is not None:
            show(self._heat, heat)

    def _regroup(self) -> None:
        groups = self._injections.groups(str(self._way.value))
        fill(self._table, groups.rows)
        self._more.set_text(
            f"{groups.left} more groups, each with fewer injections, are not shown." if groups.left else ""
        )


def draw(view: ui.echart, options: charts.Options, rows: int) -> None:
    """Show other options in a chart of so many rows."""
    show(view, FindingsChart.of(options, rows))


def show(view: ui.echart, chart: FindingsChart) -> None:
    """Show another chart in ``view``."""
    if view.props.get("options") is chart.options:
        return
    view.props["options"] = chart.options
    view.style(charts.height(chart.rows))
    view.update()


def fill(table: ui.table, rows: Sequence[Row]) -> None:
    """Replace the rows of a table."""
    if table.rows != rows:
        table.rows = list(rows)
