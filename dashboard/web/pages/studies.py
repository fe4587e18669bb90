"""The paper's experiments: what it found, what we have found, and the command that finds more."""

from __future__ import annotations

from pathlib import Path

from nicegui import ui

from dashboard.analysis.kernel_study import RESULTS, shares
from dashboard.api.service import Service
from dashboard.campaigns.flight_record import FlightRecord
from dashboard.campaigns.statistics.proportions import Interval
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.campaigns.store.store import Store
from dashboard.studies import kernels_alone
from dashboard.studies.kernels_alone import counts_of, statements
from dashboard.studies.paper import FINDINGS, STUDIES, PaperValue, success, success_between, worst
from dashboard.studies.study import TABLE
from dashboard.web.charts import charts
from dashboard.web.components.breakdown import draw
from dashboard.web.components.frame import REFUSED, ask, frame, nothing, section, trouble
from dashboard.web.components.outcome_shares import in_words
from dashboard.web.components.quality_tables import Row, table
from deploy.kernel_study.file import kept_runs
from injector.kernel_study.results import StudyRun

LOOKED_AT = 200
"""Campaigns among which the newest of a study is looked for."""

KERNEL_STUDY = "kernel_study.jsonl"
"""The file in the store's folder that is shown here."""

Studied = dict[str, tuple[CampaignEntry, list[FlightRecord]]]


def studied(store: Store) -> Studied:
    """The newest campaign of each study that has a result, with its runs."""
    found: Studied = {}
    for one in store.newest(LOOKED_AT):
        if one.spec.name in STUDIES and one.spec.name not in found:
            records = [record for record in store.records(one) if record.result is not None]
            if records:
                found[one.spec.name] = one, records
    return found


def register(service: Service) -> None:
    """Declare the page of the studies."""

    @ui.page("/studies", response_timeout=60)
    async def page() -> None:
        with frame("Studies"):
            ui.label(
                "The experiments of the paper (Hsiao et al., ROSFI) beside our flights. Worlds, vehicle and "
                "simulator are not the paper's, so shares and changes are set side by side, not seconds. In "
                "brackets: 95 % intervals; the longest of some flights has none."
            ).classes("note")
            try:
                found = await ask(studied, service.store)
                kernels = await ask(kept_runs, service.store.folder / KERNEL_STUDY)
            except REFUSED as error:
                trouble(str(error), "Load this page again once that is put right.")
                return
            _kernels(service.store.folder / KERNEL_STUDY, kernels)
            for name in STUDIES:
                with section(TABLE[name].title, anchor=name):
                    ui.label(TABLE[name].about).classes("note")
                    _study(name, found)


def _study(name: str, found: Studied) -> None:
    command = f"zenfi campaign run {name}"
    if name not in found:
        remedy = f"{command}, or a part of it: --scale 0.1"
        nothing("Not flown here yet.", remedy, ("fly it here", f"/new?preset={name}"))
        return
    campaign, records = found[name]
    with ui.row().classes("links"):
        ui.link(campaign.label, f"/campaigns/{campaign.label}")
        ui.label(f"{len(records)} flights; the same again: {command}").classes("note")
        ui.link("fly it here", f"/new?preset={name}")
    findings = FINDINGS.get(name, [])
    if findings:
        _side_by_side(findings, records)
    _by_arm(records)


def _side_by_side(findings: list[PaperValue], records: list[FlightRecord]) -> None:
    computed = [(one, one.ours(records)) for one in findings]
    rows: list[Row] = [
        {
            "what": one.what,
            "unit": one.unit,
            "paper": f"{one.paper:.1f}",
            "ours": _between(ours, one.interval(records)),
        }
        for one, ours in computed
    ]
    with ui.element("div").classes("pair"):
        units = " or ".join(dict.fromkeys(one.unit for one in findings))
        points = [
            charts.ChartPair(one.what, one.paper, ours, one.interval(records)) for one, ours in computed
        ]
        words = "The paper's numbers beside ours; the table has them in figures"
        draw(ui.echart({}).classes("chart"), charts.beside(points, units, words), len(points))
        shown = table((("what", "what"), ("paper", "paper"), ("ours", "ours (95 %)"), ("unit", "unit")))
        shown.rows = rows


def _by_arm(records: list[FlightRecord]) -> None:
    cells = list(dict.fromkeys(record.cell for record in records))
    rows: list[Row] = []
    for cell in cells:
        members = [record for record in records if record.cell == cell]
        rows.append(
            {
                "cell": str(cell),
                "flown": len(members),
                "success": _between(success(members), success_between(members)),
                "worst": _between(worst(members), None),
            }
        )
    shown = table(
        (
            ("cell", "ours"),
            ("flown", "flights"),
            ("success", "success, % (95 %)"),
            ("worst", "longest over golden, %"),
        )
    )
    shown.rows = rows


def _kernels(path: Path, found: dict[str, list[StudyRun]]) -> None:
    with section(kernels_alone.TITLE):
        ui.label(kernels_alone.ABOUT).classes("note")
        command = f"zenfi kernels run --output {path}"
        if not found:
            nothing("Not made here yet.", f"{command}, or a part of it: --injections 500")
            return
        ui.label(f"{sum(map(len, found.values()))} injections; to go on: {command}").classes("note")
        counts = [{name: share.count for name, share in shares(runs).items()} for runs in found.values()]
        chart = ui.echart({}).classes("chart")
        words = "What became of kernels, of the injected, per cent"
        draw(chart, charts.stacked(list(found), counts, "of the injected, %", words), len(found))
        shown = table((("kernel", "kernel"), *((name, f"{name}, % (95 %)") for name in RESULTS)))
        shown.rows = [{"kernel": kernel} | in_words(shares(runs)) for kernel, runs in found.items()]
        claimed = table((("what", "what"), ("paper", "paper"), ("ours", "ours (95 %)"), ("verdict", "")))
        claimed.rows = [one._asdict() for one in statements(counts_of(found))]


def _between(value: float | None, interval: Interval | None) -> str:
    """A number with its interval; what rounds to nothing has no sign."""
    if value is None:
        return "-"
    told, *ends = (f"{one:z.1f}" for one in (value, *(interval or ())))
    return f"{told} ({' to '.join(ends)})" if ends else told
