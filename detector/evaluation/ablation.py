"""What inputs, window and preprocessing are worth to the paper's two schemes: one thing is changed at a time.

Variants are judged as schemes are, on recorded flights, at control, where both watch each tick. They are
the schemes' ideas and not the code that flies: an alarmed tick is the predecessor of the next like any other,
and the Gaussian learns nothing in flight.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from detector.evaluation.coverage import HarmReport, JudgedFlight
from detector.schemes.autoencoder import INPUTS
from detector.schemes.base import Floats
from detector.series.changes import changes
from detector.series.monitored_states import WATCHED
from detector.series.preprocessing import levels
from detector.series.series import Series

STAGE = "control"
COMMAND = ("command.vx", "command.vy", "command.vz", "command.yaw_rate")
ODOMETRY = tuple(f"odometry.{name}" for name in ("x", "y", "z", "vx", "vy", "vz"))
WAYPOINT = INPUTS[:9]

MOST_ROWS = 20_000
"""Rows that a variant is trained on: more are drawn from."""

HIDDEN = (6, 3)
"""Units of the autoencoder's hidden layers."""


class Variant(NamedTuple):
    """A scheme with these ``inputs``, the mean of their changes over ``window`` ticks, in this ``form``.

    ``power`` is what the autoencoder's inputs are raised to. ``form`` is one of
    :data:`detector.series.preprocessing.FORMS`.
    """

    name: str
    scheme: Literal["gaussian", "autoencoder"]
    inputs: tuple[str, ...]
    window: int = 1
    form: str = "folded"
    power: int = 3


VARIANTS = (
    Variant("AAD", "autoencoder", INPUTS),
    Variant("AAD, waypoint alone", "autoencoder", WAYPOINT),
    Variant("AAD, and yaw rate", "autoencoder", (*INPUTS, "command.yaw_rate")),
    Variant("AAD, and odometry", "autoencoder", (*INPUTS, *ODOMETRY)),
    Variant("AAD, 5 ticks", "autoencoder", INPUTS, window=5),
    Variant("AAD, 25 ticks", "autoencoder", INPUTS, window=25),
    Variant("AAD, bits as they stand", "autoencoder", INPUTS, form="naive"),
    Variant("AAD, values", "autoencoder", INPUTS, form="raw"),
    Variant("AAD, not cubed", "autoencoder", INPUTS, power=1),
    Variant("AAD, values, odometry, 25 ticks", "autoencoder", (*INPUTS, *ODOMETRY), window=25, form="raw"),
    Variant("GAD", "gaussian", COMMAND),
    Variant("GAD, inputs of AAD", "gaussian", INPUTS),
    Variant("GAD, and odometry", "gaussian", (*COMMAND, *ODOMETRY)),
    Variant("GAD, 5 ticks", "gaussian", COMMAND, window=5),
    Variant("GAD, 25 ticks", "gaussian", COMMAND, window=25),
    Variant("GAD, bits as they stand", "gaussian", COMMAND, form="naive"),
    Variant("GAD, values", "gaussian", COMMAND, form="raw"),
    Variant("GAD, values, odometry, 25 ticks", "gaussian", (*COMMAND, *ODOMETRY), window=25, form="raw"),
)


def judged_by(variant: Variant, lessons: Sequence[Series], flights: Sequence[Series]) -> list[JudgedFlight]:
    """Have a variant that has learned from ``lessons``, golden flights, judge others."""
    rows = np.unique(np.concatenate([features(one, variant) for one in lessons]), axis=0)
    if len(rows) > MOST_ROWS:
        rows = rows[np.random.default_rng(0).choice(len(rows), MOST_ROWS, replace=False)]
    score = _gaussian(rows) if variant.scheme == "gaussian" else _autoencoder(rows, variant.power)
    with np.errstate(over="ignore", invalid="ignore"):  # a fault makes any number
        return [_judged(one, score(features(one, variant))) for one in flights]


def features(flight: Series, variant: Variant) -> Floats:
    """The mean change of each input over the last ticks (ticks, inputs); before the first nothing changed."""
    checks = flight.checks[STAGE]
    changed = changes(STAGE, checks, variant.form)
    for name in ODOMETRY:
        values = checks.values[1::2, WATCHED[STAGE].index(name)]
        seen = levels(name.replace("odometry", "trajectory"), values, variant.form)
        changed[name] = np.diff(seen, prepend=seen[:1])
    rows = np.column_stack([changed[name] for name in variant.inputs])
    before = np.zeros((variant.window - 1, rows.shape[1]))
    found: Floats = sliding_window_view(np.concatenate((before, rows)), variant.window, axis=0).mean(axis=-1)
    return found


def _judged(flight: Series, scores: Floats) -> JudgedFlight:
    harm = flight.about.get("harm")
    return JudgedFlight(
        float(flight.about["time_s"]),
        flight.checks[STAGE].times_s,
        np.nan_to_num(scores, nan=np.inf, posinf=np.inf),
        None if harm is None else HarmReport.model_validate(harm),
    )


def _gaussian(rows: Floats) -> Callable[[Floats], Floats]:
    """The distance from the mean of the worst input, in units of the largest of the training flights."""
    mean = rows.mean(axis=0)
    largest = np.maximum(np.abs(rows - mean).max(axis=0), 1e-9)

    def score(seen: Floats) -> Floats:
        worst: Floats = (np.abs(seen - mean) / largest).max(axis=1)
        return worst

    return score


def _autoencoder(rows: Floats, power: int) -> Callable[[Floats], Floats]:
    """The mean squared error of what the network makes of its inputs, which are within +-1 in training."""
    from detector.schemes.network_training import fit  # noqa: PLC0415 - torch takes seconds

    scale = np.maximum(np.abs(rows).max(axis=0), 1e-9)
    seen = (rows / scale) ** power
    sizes = (rows.shape[1], *HIDDEN, rows.shape[1])
    *bent, last = [(np.array(weight), np.array(bias)) for weight, bias in fit(seen, seen, sizes, 0)]

    def score(changed: Floats) -> Floats:
        wanted = (changed / scale) ** power
        made = wanted
        for weight, bias in bent:
            made = made @ weight.T + bias
            made = made / (1.0 + np.abs(made))
        off: Floats = ((made @ last[0].T + last[1] - wanted) ** 2).mean(axis=1)
        return off

    return score
