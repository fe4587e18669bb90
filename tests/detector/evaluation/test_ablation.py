"""Variants of the paper's schemes see what their inputs, window and preprocessing let them see."""

import numpy as np
import pytest

from detector.evaluation.ablation import COMMAND, ODOMETRY, VARIANTS, Variant, features, judged_by
from detector.schemes.autoencoder import INPUTS
from detector.series.monitored_states import WATCHED
from detector.series.series import Checks, Series
from tests.detector.flights import flight

LESSONS = [flight(phase, seed) for seed, phase in enumerate(np.linspace(0.0, 6.0, 8))]
STRUCK = 100
"""The tick from which a flight is changed."""


def changed(state: str, added: np.ndarray | float) -> Series:
    """A flight with something added to a state at control from a tick on."""
    one = flight(0.7, 99)
    ticks = one.checks["control"]
    values = ticks.values.copy()
    rows = values.reshape(-1, 2, values.shape[1])
    rows[STRUCK:, :, WATCHED["control"].index(state)] += np.reshape(added, (-1, 1))
    return Series(
        {**one.checks, "control": Checks(values, ticks.first, ticks.times_s)}, {**one.about, "time_s": 40.0}
    )


def finds(variant: Variant, struck: Series) -> bool:
    """Whether a struck flight scores more than all golden ones."""
    golden = [Series(one.checks, {**one.about, "time_s": 40.0}) for one in LESSONS]
    *others, found = judged_by(variant, golden, [*golden, struck])
    assert (found.scores >= 0.0).all()
    return found.largest > 1.001 * max(one.largest for one in others)


@pytest.mark.parametrize("variant", [one for one in VARIANTS if one.scheme == "gaussian"])
def test_each_gaussian_finds_a_command_that_is_not_finite(variant: Variant) -> None:
    assert finds(variant, changed("command.vx", np.inf))


@pytest.mark.parametrize("power", [1, 3])
def test_the_autoencoder_finds_a_waypoint_that_jumps(power: int) -> None:
    assert finds(Variant("", "autoencoder", INPUTS, power=power), changed("command.vz", 1e6))


def test_a_slow_drift_of_odometry_needs_odometry_values_and_a_window() -> None:
    steps = len(flight(0.7, 99).checks["control"]) - STRUCK
    drifting = changed("odometry.z", 0.01 * np.arange(float(steps)))
    drift = Variant("", "gaussian", (*COMMAND, *ODOMETRY), window=25, form="raw")
    assert finds(drift, drifting)
    assert not finds(drift._replace(inputs=COMMAND), drifting)


def test_a_window_is_the_mean_of_the_changes_up_to_its_tick() -> None:
    one = Variant("", "gaussian", ("odometry.x",), form="raw")
    each = features(LESSONS[0], one)[:, 0]
    mean = features(LESSONS[0], one._replace(window=4))[:, 0]
    assert len(mean) == len(each)
    assert mean[7] == pytest.approx(each[4:8].mean())
    assert mean[1] == pytest.approx(each[:2].sum() / 4)


def test_variants_have_names_of_their_own_and_differ() -> None:
    assert len({one.name for one in VARIANTS}) == len({one[1:] for one in VARIANTS}) == len(VARIANTS)
