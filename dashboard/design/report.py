"""What a study of designs leaves in a folder: page, document, table, figure, and campaigns to fly."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from io import StringIO
from pathlib import Path

from dashboard.analysis import plots
from dashboard.campaigns.spec import CampaignSpec
from dashboard.design.document import CAMPAIGNS, DOCUMENT, DesignLine, DesignStudy, OptionLine
from dashboard.design.overheads import RelativeOverhead
from dashboard.design.prediction import HarmPrediction
from dashboard.design.specification import to_toml
from deploy.errors import BadSpecError

PAGE, TABLE, FIGURE = "README.md", "front.csv", "designs.svg"
"""The files beside the document and the campaigns."""

ASSUMPTIONS = """\
- Protections act independently: on the same strike each keeps, in a combination, the effect that it had
  alone. A strike that harmed bare harms if none of them averted it; one that did not harms if any of them
  added harm.
- Overheads of flight time and energy add, those of further computers too.
- DMR and TMR mask every upset of a kernel that runs on them: their residual of 0 is assumed, not measured.
  TMR masks by vote. DMR has the output made again, so it is no option against a fault that recurs. Neither is
  one against faults of sensors and motors, which all computers share.
- What further computers draw themselves is left out, as in the model of `zenfi redundancy`.
- Strikes are independent of each other; where several of them flew one seed, intervals are too narrow.
- Upsets come at a constant rate and independently, so rates of elements add (`zenfi evidence`).
"""

_ABOUT_FRONT = """\
No other design is as good in all of bound, flight time, energy and mass. Overheads are parts of the bare
flight's, with intervals of 95 % where they were measured. What a design has on for one element is on for all
of them."""

_ABOUT_OPTIONS = """\
Harm in strikes, with intervals of 95 % (Clopper-Pearson). The difference is beside the same strikes bare
(Newcombe, paired)."""

_HEADS = (
    "design",
    "options",
    "rate_per_hour",
    "bound_per_hour",
    "meets_target",
    "flight_time",
    "flight_time_low",
    "flight_time_high",
    "energy",
    "energy_low",
    "energy_high",
    "mass_kg",
    "predicted_harm",
    "predicted_low",
    "predicted_high",
    "strikes",
)


def write(folder: Path, found: DesignStudy, campaigns: Mapping[str, CampaignSpec]) -> None:
    """Write all files of a study into a folder, which is made.

    :raises BadSpecError: if it cannot be written, or matplotlib is not installed.
    """
    lines = found.lines
    contents = {
        PAGE: page(found),
        DOCUMENT: found.model_dump_json(indent=1) + "\n",
        TABLE: _table(found.front),
        FIGURE: _figure(found),
        **{f"{CAMPAIGNS}/{name}.toml": to_toml(one, _about(lines[name])) for name, one in campaigns.items()},
    }
    try:
        (folder / CAMPAIGNS).mkdir(parents=True, exist_ok=True)
        for name, content in contents.items():
            (folder / name).write_text(content)
    except OSError as error:
        message = f"{folder}: {error.strerror}"
        raise BadSpecError(message) from error


def in_words(found: DesignStudy) -> str:
    """What was found, in a sentence; of further computers, whose residual is assumed, nothing is claimed."""
    measured = [one for one in found.front if not one.scheme]
    told = (
        f"{found.designs} designs, {len(found.front)} of them on the front. With "
        f"{100 * found.budget.confidence:.3g} % confidence faults of the listed elements cause at most "
        f"{found.bare.bound_per_hour:.3g} failures in a flight hour without protection"
    )
    if measured and measured[0].protections:
        best = measured[0]
        told += f", and at most {best.bound_per_hour:.3g} with {best.name} ({options(best)})"
    if found.budget.target_per_hour is None:
        return f"{told}."
    enough = [one for one in measured if one.meets_target]
    target = f"{found.budget.target_per_hour:.3g}"
    if not enough:
        return f"{told}. No design without further computers meets the target of {target}."
    quickest = min(enough, key=lambda one: (one.flight_time.mean, one.energy.mean))
    return f"{told}. Of those that meet the target of {target}, {quickest.name} is the quickest."


def options(design: DesignLine) -> str:
    """The options of a design, element by element."""
    return ", ".join(f"{one.element}: {one.option}" for one in design.elements)


def page(found: DesignStudy) -> str:
    """The page: the front, its predictions, the options, what they cost, and what is assumed."""
    parts = [
        f"# {found.name}: designs of its protection",
        in_words(found),
        _made(found),
        f"![designs by flight time and residual harm]({FIGURE})",
        "## The front",
        _ABOUT_FRONT,
        "\n".join(_front(found)),
        "## Predictions",
        _about_predictions(found),
        "\n".join(_predictions(found)),
        "## The options of each element",
        _ABOUT_OPTIONS,
        "\n".join(_options(found.options)),
    ]
    if found.protections:
        parts += ["## What protections cost flights without a fault", "\n".join(_protections(found))]
    if found.computers:
        parts += ["## Further computers, by model", "\n".join(_computers(found))]
    said = "".join(f"- {one}\n" for one in (*found.budget.assumptions, *_not_flown(found)))
    return "\n\n".join([*parts, "## Assumptions and limits", ASSUMPTIONS + said])


def _about_predictions(found: DesignStudy) -> str:
    name = next(one.name for one in reversed(found.lines.values()) if one.campaign is not None)
    return (
        f"The part of strikes that harms when `{CAMPAIGNS}/NAME.toml` is flown, with its prediction interval "
        "of 95 %: it accounts for how few strikes are known and for how few are to be made. Beside a short "
        "front other designs have a campaign, too.\n\n"
        f"```\nzenfi campaign run {CAMPAIGNS}/{name}.toml\nzenfi study design --check . {name}-1\n```"
    )


def _made(found: DesignStudy) -> str:
    return (
        f"Of {', '.join(found.campaigns)}; {found.combinations:,} combinations of options, "
        f"{found.impossible:,} of which exclude each other (two detectors, two pilots, or DMR and TMR). "
        f"ZenFI {found.zenfi}."
    )


def _front(found: DesignStudy) -> Iterator[str]:
    yield "| design | options | failures / h | bound | target | flight time | energy | mass, kg |"
    yield "|---|---|---|---|---|---|---|---|"
    for one in (*found.front, *([found.bare] if found.bare not in found.front else ())):
        target = {None: "", True: "met", False: "not met"}[one.meets_target]
        yield (
            f"| {one.name} | {_text(options(one))} | {one.rate_per_hour:.3g} | {one.bound_per_hour:.3g} | "
            f"{target} | {_overhead(one.flight_time)} | {_overhead(one.energy)} | +{one.mass_kg:.3g} |"
        )


def _bound(one: DesignLine) -> str:
    if all(element.masked for element in one.elements):
        return f"{one.bound_per_hour:.3g} (assumed)"
    return f"{one.bound_per_hour:.3g}" + " (in part assumed)" * bool(one.scheme)


def _predictions(found: DesignStudy) -> Iterator[str]:
    yield "| design | strikes | harm predicted |"
    yield "|---|---|---|"
    for one in found.lines.values():
        if one.prediction is None:
            yield f"| {one.name} | | all kernels on further computers: nothing to fly |"
        else:
            yield f"| {one.name} | {one.prediction.strikes} | {_predicted(one.prediction)} |"


def _predicted(one: HarmPrediction) -> str:
    return f"{100 * one.share:.3g} % ({100 * one.low:.3g} to {100 * one.high:.3g} %)"


def _options(lines: Sequence[OptionLine]) -> Iterator[str]:
    yield "| element | option | harm in strikes | difference to bare, points | unpaired |"
    yield "|---|---|---|---|---|"
    for one in lines:
        harm = "0 (assumed)"
        if one.low is not None and one.high is not None:
            harm = f"{one.harmed}/{one.struck} ({100 * one.low:.3g} to {100 * one.high:.3g} %)"
        difference = ""
        if one.difference is not None and one.difference_low is not None and one.difference_high is not None:
            ends = f"{100 * one.difference_low:z.1f} to {100 * one.difference_high:z.1f}"
            difference = f"{100 * one.difference:z.1f} ({ends})"
        yield f"| {_text(one.element)} | {_text(one.option)} | {harm} | {difference} | {one.unpaired or ''} |"


def _protections(found: DesignStudy) -> Iterator[str]:
    yield "| protection | arms | flight time | energy | golden flights lost | checks, part of the time |"
    yield "|---|---|---|---|---|---|"
    for one in found.protections:
        lost = f"{one.cost.lost}/{one.cost.arrived} (at most {100 * one.cost.lost_high:.3g} %)"
        share = _overhead(one.check_share) if one.check_share is not None else ""
        yield (
            f"| {_text(one.name)} | {_text(', '.join(one.arms))} | {_overhead(one.cost.flight_time)} | "
            f"{_overhead(one.cost.energy)} | {lost} | {share.lstrip('+')} |"
        )


def _computers(found: DesignStudy) -> Iterator[str]:
    yield "| scheme | mass, kg | flight time | energy |"
    yield "|---|---|---|---|"
    for one in found.computers:
        costs = f"{_overhead(one.flight_time)} | {_overhead(one.energy)}"
        yield f"| {one.scheme} | +{one.mass_kg:.3g} | {costs} |"


def _not_flown(found: DesignStudy) -> Iterator[str]:
    for arm in found.left_out:
        yield f"Left out, no protection of this vehicle: {arm}."
    for element, option in found.pruned:
        yield (
            f"There were too many combinations: {option} of {element} was left out, since another option "
            "of it beats it. A design that has it on for another element anyway may be missing."
        )
    for one in found.protections:
        if one.cost.lost:
            yield (
                f"{one.name} loses {one.cost.lost} of {one.cost.arrived} golden flights that arrive "
                "without it. No axis of the front counts them."
            )


def _overhead(one: RelativeOverhead) -> str:
    told = f"{100 * one.mean:+z.2f} %"
    if one.low is None or one.high is None:
        return told
    return f"{told} ({100 * one.low:z.2f} to {100 * one.high:z.2f})"


def _text(told: str) -> str:
    """Text of others in a cell of a table of Markdown."""
    return told.replace("|", "\\|").replace("<", "&lt;").replace("\n", " ")


def _about(design: DesignLine) -> list[str]:
    about = [f"{design.name}: {options(design)}".replace("\n", " ")]
    if design.prediction is not None:
        about += [
            f"Predicted: of {design.prediction.strikes} strikes {_predicted(design.prediction)} harm.",
            f"zenfi study design --check DIR {design.name}-NUMBER holds what was flown against it.",
        ]
    return about


def _table(lines: Sequence[DesignLine]) -> str:
    written = StringIO()
    writer = csv.writer(written, lineterminator="\n")
    writer.writerow(_HEADS)
    for one in lines:
        time, energy, told = one.flight_time, one.energy, one.prediction
        rates = (one.rate_per_hour, one.bound_per_hour, one.meets_target)
        costs = (time.mean, time.low, time.high, energy.mean, energy.low, energy.high, one.mass_kg)
        predicted = (told.share, told.low, told.high, told.strikes) if told is not None else (None,) * 4
        writer.writerow([one.name, options(one), *rates, *costs, *predicted])
    return written.getvalue()


def _figure(found: DesignStudy) -> str:
    others = [(time, bound) for bound, time, _, _ in found.evaluated]
    best = [(one.name, one.flight_time.mean, one.bound_per_hour, one.mass_kg) for one in found.front]
    return plots.svg(plots.trade_off(others, best, found.budget.target_per_hour))
