"""Evaluation on recorded flights."""

import math
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from detector.errors import DetectionInputError
from detector.evaluation.evaluation import evaluate
from detector.evaluation.flips import flipped, flips, largest_changes
from detector.schemes.gaussian import Gaussian
from detector.schemes.kinematic import Kinematic
from detector.series.series import Series, load_folder, load_series
from tests.detector.flights import flight

FLIGHTS = [flight(phase, seed) for seed, phase in enumerate(np.linspace(0.0, 6.0, 10))]
LARGEST = largest_changes(FLIGHTS)
GAUSSIAN = Gaussian.train([Gaussian.lesson(one) for one in FLIGHTS], 0)
KINEMATIC = Kinematic.train([Kinematic.lesson(one) for one in FLIGHTS], 0)


def test_a_flip_is_one_bit() -> None:
    assert flipped(1.5, 63, count=False) == -1.5
    assert flipped(1.0, 62, count=False) == math.inf
    assert flipped(3.0, 52, count=False) == 6.0
    assert flipped(5.0, 1, count=True) == 7.0


def test_flips_repeat_and_cover_every_bit() -> None:
    once, again = (list(flips(FLIGHTS[0], LARGEST, 2, 0)) for _ in range(2))
    assert [(flip.state, flip.bit, flip.shows) for flip in once] == [
        (flip.state, flip.bit, flip.shows) for flip in again
    ]
    assert {flip.bit for flip in once if flip.state == "trajectory.vy"} == set(range(64))
    assert {flip.bit for flip in once if flip.state == "trajectory.trajectory_seq"} == set(range(32))
    tracked = next(flip for flip in once if flip.state == "trajectory.vy")
    assert [show.stage for show in tracked.shows] == ["planning", "control"]


def test_every_change_beyond_the_largest_golden_one_is_found_by_the_gaussian() -> None:
    result = evaluate(partial(Gaussian.load, GAUSSIAN), FLIGHTS, LARGEST, 2)
    assert result.flights == 10
    assert result.alarms == 0
    assert result.beyond
    assert all(tally.rate == 1.0 for tally in result.beyond.values())
    counts = result.confusion()
    assert counts["true_negative"] == result.checks == sum(len(c) for f in FLIGHTS for c in f.checks.values())
    assert counts["true_positive"] > 0 < counts["false_negative"]


def test_kinematic_finds_more_than_the_gaussian_and_in_the_mantissa_too() -> None:
    gauss, kinematic = (
        evaluate(partial(kind.load, parameters), FLIGHTS, LARGEST, 2)
        for kind, parameters in ((Gaussian, GAUSSIAN), (Kinematic, KINEMATIC))
    )
    assert kinematic.alarms == 0
    assert kinematic.confusion()["true_positive"] > gauss.confusion()["true_positive"]
    assert kinematic.fields["trajectory.x", "mantissa"].rate > 0.1
    assert gauss.fields["trajectory.x", "mantissa"].rate < 0.02


def test_a_roc_falls_from_all_to_nothing() -> None:
    result = evaluate(partial(Gaussian.load, GAUSSIAN), FLIGHTS[:3], LARGEST, 1)
    limits, false, found = zip(*result.roc(), strict=True)
    assert list(limits) == sorted(limits)
    assert list(false) == sorted(false, reverse=True)
    assert list(found) == sorted(found, reverse=True)
    assert 0.5 < result.area() <= 1.0


def test_delay_is_counted_from_the_fault() -> None:
    clean = FLIGHTS[0]
    values = clean.checks["control"].values.copy()
    values[200:202, 11] = -2.0  # the command of tick 100
    checks = {**clean.checks, "control": type(clean.checks["control"])(values, *_rest(clean))}
    bad = Series(checks, {**clean.about, "injected_s": 4.96, "sdc": True})
    result = evaluate(partial(Gaussian.load, GAUSSIAN), [bad], LARGEST, 1)
    assert (result.injected, result.injected_sdc, result.early_alarms) == (1, 1, 0)
    assert result.delays_s == [pytest.approx(1.0 + 0.04 * 100 - 4.96)]


def _rest(clean: Series) -> tuple[np.ndarray, np.ndarray]:
    control = clean.checks["control"]
    return control.first, control.times_s


def test_a_series_is_read_back_as_it_was_written_and_rubbish_refused(tmp_path: Path) -> None:
    FLIGHTS[3].save(tmp_path / "a.npz")
    (again,) = load_folder(tmp_path)
    assert again.about == FLIGHTS[3].about
    for stage, checks in FLIGHTS[3].checks.items():
        np.testing.assert_array_equal(again.checks[stage].values, checks.values)
        np.testing.assert_array_equal(again.checks[stage].first, checks.first)
    content = (tmp_path / "a.npz").read_bytes()
    for rubbish in (b"", b"PK", content[: len(content) // 2]):
        (tmp_path / "b.npz").write_bytes(rubbish)
        with pytest.raises(DetectionInputError, match=r"b\.npz"):
            load_series(tmp_path / "b.npz")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DetectionInputError, match="no recorded flight"):
        load_folder(tmp_path / "empty")
