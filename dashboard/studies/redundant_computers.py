"""The paper's Fig. 15: what two and three computers cost two airframes by their weight, and the page of it.

Nothing is flown: the factors are those of :func:`sim.vehicle.redundancy.study`. They hang on two numbers that
are not published, the weight of a computer and the lift of the Spark, so the page shows them for others, too.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from pydantic import Field

from dashboard.analysis import plots
from dashboard.studies.folder import FIGURE, PAGE
from deploy.errors import BadSpecError
from services.models.base import Strict
from sim.vehicle.redundancy import RedundancyResult, RedundancyStudy, study

TITLE = "Fig. 15: two and three computers on two airframes"

ABOUT = (
    "What do two (DMR) and three computers (TMR) cost a vehicle that has to lift them? The paper (section "
    "VII-D): TMR lengthens the flight 1.06 times on the AirSim UAV and 1.91 times on the Spark."
)

PAPER = {("airsim", "TMR"): 1.06, ("spark", "TMR"): 1.91}
"""How many times longer the flight is, by airframe and scheme."""

CLOSE = 0.02
"""A factor of ours agrees if it differs by so much of the paper's at most: two figures are published."""

FITTED = ("spark",)
"""Airframes whose lift is not published and was chosen so that the model gives the paper's factor."""

TIMES, SPEC = "times.csv", "redundancy.json"

_HEAVIEST_KG = 0.2
_WEIGHTS = 5

_MOST_TIMES = 4.0
"""Where a curve ends: close to where a vehicle cannot lift itself it rises without end."""


class RedundantComputers(Strict):
    """What is asked of the study: airframes, the weight of each further computer, response time, sight."""

    name: Literal["fig15"] = "fig15"
    airframes: tuple[str, ...] = Field(default=("airsim", "spark"), min_length=1)
    computer_kg: float = Field(default=0.085, gt=0, le=_HEAVIEST_KG)
    response_s: float = Field(default=0.289, ge=0, le=60)
    range_m: float = Field(default=7.0, gt=0, le=1000)

    def scaled(self, _factor: float) -> RedundantComputers:
        """The same: a model has no sample."""
        return self

    def of(self, airframe: str, computer_kg: float | None = None) -> list[RedundancyResult]:
        """One, two and three computers on an airframe; of another weight if it is given."""
        asked = RedundancyStudy(
            airframe=airframe,
            response_s=self.response_s,
            range_m=self.range_m,
            computer_kg=self.computer_kg if computer_kg is None else computer_kg,
        )
        return study(asked)


class _Row(NamedTuple):
    airframe: str
    result: RedundancyResult


def write(folder: Path, asked: RedundantComputers) -> None:
    """Write the page, its table, its figure and its specification into a folder, which is there.

    :raises BadSpecError: if it cannot be written, or matplotlib is not installed.
    :raises sim.vehicle.airframe.BadAirframeError: if there is no such airframe.
    """
    rows = [_Row(name, result) for name in asked.airframes for result in asked.of(name)]
    try:
        with (folder / TIMES).open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(("airframe", *RedundancyResult.model_fields))
            writer.writerows((row.airframe, *row.result.model_dump().values()) for row in rows)
        figure = plots.lines(
            TITLE, "each further computer, g", "flight time, times that with one", _curves(asked)
        )
        (folder / FIGURE).write_text(plots.svg(figure))
        (folder / SPEC).write_text(asked.model_dump_json(indent=1) + "\n")
        (folder / PAGE).write_text(page(asked, rows))
    except OSError as error:
        message = f"{folder}: {error.strerror}"
        raise BadSpecError(message) from error


def page(asked: RedundantComputers, rows: Sequence[_Row]) -> str:
    """The page: the model's inputs, the paper's factors beside ours, and other weights of a computer."""
    again = f"zenfi study run {asked.name}\nzenfi study run {SPEC}  # this page again"
    inputs = (
        f"A computer weighs {1000 * asked.computer_kg:g} g, the vehicle responds within "
        f"{1000 * asked.response_s:g} ms and sees {asked.range_m:g} m far. Nothing is flown: "
        "v = a (sqrt(T^2 + 2 d / a) - T), a = g sqrt((T/W)^2 - 1) (Krishnan et al. 2020), and the flight "
        "time goes with 1 / v."
    )
    parts = [
        f"# {TITLE}",
        ABOUT,
        f"{inputs}\n\n```\n{again}\n```",
        f"![flight time by the weight of a computer]({FIGURE})",
        "## The paper's factors beside ours",
        "\n".join(_side_by_side(rows)),
        _in_words(rows),
        "## If a computer weighs more or less",
        "\n".join(_other_weights(asked)),
    ]
    return "\n\n".join(parts) + "\n"


def _side_by_side(rows: Sequence[_Row]) -> Iterator[str]:
    yield "| airframe | | mass kg | thrust / weight | safe velocity m/s | flight time | paper | |"
    yield "|---|---|---|---|---|---|---|---|"
    for airframe, one in rows:
        paper = PAPER.get((airframe, one.scheme))
        cells = (f"{one.mass_kg:.3f}", f"{one.thrust_to_weight:.2f}", f"{one.safe_velocity_m_s:.2f}")
        told = "" if paper is None else f"x {paper:.2f}"
        judged = f"{_times(one)} | {told} | {verdict(airframe, one)}"
        yield f"| {airframe} | {one.scheme} | {' | '.join(cells)} | {judged} |"


def verdict(airframe: str, one: RedundancyResult) -> str:
    """Whether a factor agrees with the paper's; a model with an input that was fitted cannot confirm it."""
    paper = PAPER.get((airframe, one.scheme))
    if paper is None:
        return ""
    if one.time_factor is None or abs(one.time_factor / paper - 1) > CLOSE:
        return "not confirmed"
    return "fitted" if airframe in FITTED else "agrees"


def _in_words(rows: Sequence[_Row]) -> str:
    verdicts = [(row.airframe, verdict(*row)) for row in rows if verdict(*row)]
    meanings = {
        "agrees": "it follows from published inputs and an assumed weight of a computer",
        "fitted": "the lift of this airframe is not published; it was chosen so that the factor comes out",
        "not confirmed": f"it differs by more than {100 * CLOSE:.0f} %",
    }
    told = [
        f"**{name.capitalize()}** ({meaning}): {', '.join(one for one, of in verdicts if of == name)}."
        for name, meaning in meanings.items()
        if any(of == name for _, of in verdicts)
    ]
    return "\n\n".join(
        [*told, "A model without a sample has no interval. Extra power is left out, as in the paper."]
    )


def _other_weights(asked: RedundantComputers) -> Iterator[str]:
    yield f"| a computer, g | {' | '.join(f'{name} DMR | {name} TMR' for name in asked.airframes)} |"
    yield "|---|" + "---|---|" * len(asked.airframes)
    for step in range(1, _WEIGHTS + 1):
        weight_kg = _HEAVIEST_KG * step / _WEIGHTS
        cells = [_times(one) for name in asked.airframes for one in asked.of(name, weight_kg)[1:]]
        yield f"| {1000 * weight_kg:.0f} | {' | '.join(cells)} |"


def _curves(asked: RedundantComputers) -> dict[str, list[tuple[float, float | None]]]:
    """Of each airframe and scheme: flight time by a computer's weight in g; None where it hardly flies."""
    curves: dict[str, list[tuple[float, float | None]]] = {}
    for name in asked.airframes:
        for step in range(41):
            weight_kg = _HEAVIEST_KG * step / 40
            for one in asked.of(name, weight_kg)[1:]:
                known = one.time_factor is not None and one.time_factor <= _MOST_TIMES
                curve = curves.setdefault(f"{name} {one.scheme}", [])
                curve.append((1000 * weight_kg, one.time_factor if known else None))
    return curves


def _times(one: RedundancyResult) -> str:
    return "cannot fly" if one.time_factor is None else f"x {one.time_factor:.2f}"
