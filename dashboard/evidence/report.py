"""The file that is handed in: one page of HTML with all that it needs, and the same as JSON and CSV."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from importlib.resources import files
from io import StringIO
from pathlib import Path

import jinja2

from dashboard.analysis import plots
from dashboard.campaigns.spec import CampaignSpec
from dashboard.evidence.budget import Stated
from dashboard.evidence.evidence import Evidence, HarmfulStrike, LineEvidence, Margin
from deploy.errors import BadSpecError
from services.models.base import Strict

PAGE, DOCUMENT, LEDGER, FAULTS, CAMPAIGNS = (
    "evidence.html",
    "evidence.json",
    "ledger.csv",
    "faults.csv",
    "campaigns",
)
"""The files of a folder; ``campaigns`` has the specification of each."""


def write(folder: Path, evidence: Evidence, specs: Mapping[str, CampaignSpec]) -> None:
    """Write all files of a claim into a folder, which is made; ``specs`` are the campaigns' by label.

    :raises BadSpecError: if it cannot be written, or matplotlib is not installed.
    """
    contents = {
        PAGE: page(evidence),
        DOCUMENT: evidence.model_dump_json(indent=1) + "\n",
        LEDGER: _table(LineEvidence, evidence.lines),
        FAULTS: _table(HarmfulStrike, evidence.dominant),
        **{
            f"{CAMPAIGNS}/{label}.json": spec.model_dump_json(indent=1, exclude_unset=True) + "\n"
            for label, spec in specs.items()
        },
    }
    try:
        (folder / CAMPAIGNS).mkdir(parents=True, exist_ok=True)
        for name, content in contents.items():
            (folder / name).write_text(content)
    except OSError as error:
        message = f"{folder}: {error.strerror}"
        raise BadSpecError(message) from error


def page(evidence: Evidence) -> str:
    """The page: self-contained, all that was told by others escaped."""
    template = (files("dashboard") / "evidence" / "report.html").read_text()
    made = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(template)
    return made.render(
        evidence=evidence,
        lines=list(zip(evidence.lines, evidence.budget.elements, strict=True)),
        claim=claim(evidence),
        more=more(evidence),
        figure=_figure(evidence),
        percent=_percent,
        rate=_rate,
        share=_share,
        stated=_stated,
        median=_median,
        replays=_replays,
    )


def claim(evidence: Evidence) -> str:
    """What is claimed, in a sentence."""
    confidence, bound = _percent(evidence.confidence), _rate(evidence.bound_per_hour)
    told = (
        f"With {confidence} confidence, faults of the listed elements cause at most {bound} failures in a "
        f"flight hour; the estimate is {_rate(evidence.rate_per_hour)}."
    )
    if evidence.target_per_hour is None:
        return told
    verdict = "meets" if evidence.meets_target else "does not meet"
    return f"{told} The bound {verdict} the target of {_rate(evidence.target_per_hour)}."


def more(evidence: Evidence) -> str:
    """What is still needed for the claim, in a sentence."""
    if evidence.target_per_hour is None:
        return "The budget names no target."
    if evidence.more_strikes == 0:
        return "No more flights are needed for the target."
    if evidence.more_strikes is None:
        return "No number of further strikes without harm meets the target: the rate of harm is too high."
    return (
        f"The target needs {evidence.more_strikes:,} more strikes of the same mixture, if none of them harms "
        "a mission."
    )


def _figure(evidence: Evidence) -> str:
    """The elements' rates as SVG without its XML head."""
    rows = [(line.element, line.rate_per_hour, line.bound_per_hour) for line in evidence.lines]
    rows.append(("all", evidence.rate_per_hour, evidence.bound_per_hour))
    text = plots.svg(plots.rates(rows, evidence.target_per_hour))
    return text[text.index("<svg") :]


def _table(model: type[Strict], rows: Sequence[Strict]) -> str:
    written = StringIO()
    writer = csv.DictWriter(written, list(model.model_fields), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        told = row.model_dump()
        writer.writerow({name: " ".join(one) if isinstance(one, list) else one for name, one in told.items()})
    return written.getvalue()


def _percent(part: float) -> str:
    return f"{100 * part:.3g} %"


def _rate(per_hour: float) -> str:
    return f"{per_hour:.3g}"


def _share(found: int, of: int, low: float, high: float) -> str:
    return f"{found}/{of} ({100 * low:.3g} to {100 * high:.3g} %)"


def _stated(one: Stated) -> str:
    told = f"{one.value:g}"
    return told if one.low is None else f"{told} ({one.low:g} to {one.high:g})"


def _median(one: Margin) -> str:
    told = f"{one.median_s:.2f}"
    if one.median_low_s is None or one.median_high_s is None:
        return told
    return f"{told} ({one.median_low_s:.2f} to {one.median_high_s:.2f})"


def _replays(answers: Mapping[str, int]) -> str:
    if not answers:
        return "none: zenfi replay LABEL"
    return ", ".join(f"{count} {answer.replace('_', ' ')}" for answer, count in sorted(answers.items()))
