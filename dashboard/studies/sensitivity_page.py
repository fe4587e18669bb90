"""What the sensitivity map leaves in a folder: page, table and figure."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

from dashboard.analysis import plots
from dashboard.campaigns.statistics.proportions import wilson
from dashboard.studies.folder import PAGE
from dashboard.studies.ranking import KernelRate
from dashboard.studies.sensitivity import MapField, SensitivityMap, most_sensitive
from deploy.errors import BadSpecError

TABLE, FIGURE = "map.csv", "map.svg"

_LEGEND = (
    "Per cent of the faults that harmed the mission beside its golden twin, with 95 % Wilson intervals, and\n"
    "of how many. Phases are parts of the golden twin's flight; *after* is once it has landed."
)


def write(folder: Path, labels: Sequence[str], found: SensitivityMap) -> None:
    """Write the page of the campaigns ``labels``, its table and its figure into a folder, which is made.

    :raises BadSpecError: if it cannot be written, or matplotlib is not installed.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / TABLE).open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow((*MapField._fields, "struck", "harmed", "low", "high"))
            for at, rate in found.fields.items():
                writer.writerow((*at, rate.of, rate.found, *wilson(*rate)))
        (folder / FIGURE).write_text(plots.svg(plots.heat_map("Faults that harm, %", *_drawn(found))))
        (folder / PAGE).write_text(page(labels, found))
    except OSError as error:
        message = f"{folder}: {error.strerror}"
        raise BadSpecError(message) from error


def page(labels: Sequence[str], found: SensitivityMap) -> str:
    """The page: what was counted, the fields that harm most, and a table for each place."""
    parts = [
        "# Sensitivity map",
        "Which bits of which place harm the mission, and in which phase of the flight?",
        f"```\nzenfi study map {' '.join(labels)} --phases {len(found.phases) - 1}\n```",
        _counted(found),
        f"![harm by place, bits and phase]({FIGURE})",
        "## The fields that harm most",
        "\n".join(_most(found)),
        "## By place",
        _LEGEND,
    ]
    for pilot, place in found.places():
        parts += [f"### `{place}`, {pilot}", "\n".join(_by_phase(found, pilot, place))]
    return "\n\n".join(parts) + "\n"


def _counted(found: SensitivityMap) -> str:
    harmed = sum(one.found for one in found.fields.values())
    told = f"{found.struck:,} faults struck once, {harmed:,} of them harmed."
    left = ", ".join(f"{count:,} {reason}" for reason, count in found.left_out.items())
    return f"{told} Left out: {left}." if left else told


def _most(found: SensitivityMap) -> Iterator[str]:
    most = most_sensitive(found)
    if not most:
        yield "None of the faults harmed."
        return
    yield "| place | pilot | bits | phase | harmed, % |"
    yield "|---|---|---|---|---|"
    for at, rate, _ in most:
        yield f"| `{at.place}` | {at.pilot} | {at.part} | {at.phase} | {_percent(rate)} |"


def _by_phase(found: SensitivityMap, pilot: str, place: str) -> Iterator[str]:
    yield f"| bits | {' | '.join(found.phases)} | whole flight |"
    yield "|---|" + "---|" * (len(found.phases) + 1)
    for part in found.parts(pilot, place):
        fields = [found.fields.get(MapField(pilot, place, part, phase)) for phase in found.phases]
        cells = [*fields, found.over_phases(pilot, place, part)]
        yield f"| {part} | {' | '.join('' if one is None else _percent(one) for one in cells)} |"


def _percent(rate: KernelRate) -> str:
    low, high = wilson(*rate)
    return f"{100 * rate.rate:.0f} ({100 * low:.0f} to {100 * high:.0f}) of {rate.of}"


def _drawn(
    found: SensitivityMap,
) -> tuple[list[str], Sequence[str], dict[tuple[int, int], tuple[float, str]]]:
    """Names of rows and columns, and by row and column the rate in per cent and what is written there."""
    several = len({pilot for pilot, _ in found.places()}) > 1
    rows: list[str] = []
    fields: dict[tuple[int, int], tuple[float, str]] = {}
    for pilot, place in found.places():
        for part in found.parts(pilot, place):
            for column, phase in enumerate(found.phases):
                rate = found.fields.get(MapField(pilot, place, part, phase))
                if rate is not None:
                    fields[len(rows), column] = 100 * rate.rate, f"{rate.found}/{rate.of}"
            rows.append(f"{pilot} {place}: {part}" if several else f"{place}: {part}")
    return rows, found.phases, fields
