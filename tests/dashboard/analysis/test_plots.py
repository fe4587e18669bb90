"""Plots show what they are given: paths, the fault, topics that strayed, cells."""

from pathlib import Path

import numpy as np
import pytest

from dashboard.analysis import plots
from dashboard.analysis.recordings_reader import open_run
from deploy.errors import BadSpecError
from tests.dashboard.recorded import flights

__all__ = ["flights"]


def test_a_path_lies_beside_its_twins(flights: dict[str, Path]) -> None:
    run, twin = open_run(flights["faulty"]), open_run(flights["golden"])
    above, beside = run.plot(twin).axes
    assert [line.get_label() for line in above.lines] == ["golden twin", "flight"]
    assert np.size(above.lines[1].get_xdata()) == len(run.messages["odometry"])
    assert len(above.patches) > 5
    assert [line.get_label() for line in beside.lines] == ["golden twin", "flight", "fault"]
    assert run.injection is not None
    assert np.min(np.asarray(beside.lines[2].get_xdata())) == run.injection.virtual_time_ns / 1e9
    assert len(run.plot().axes[0].lines) == 1


def test_propagation_has_a_panel_for_each_topic_that_strayed(flights: dict[str, Path]) -> None:
    run, twin = open_run(flights["faulty"]), open_run(flights["golden"])
    panels = run.plot_propagation(twin).axes
    labels = [panel.get_ylabel().split("\n")[0] for panel in panels]
    assert labels[0] == "trajectory"
    assert all(panel.lines for panel in panels)
    with pytest.raises(BadSpecError, match="not the golden twin"):
        twin.plot_propagation(run)


def test_an_empty_campaign_is_drawn() -> None:
    assert len(plots.quality("empty", []).axes) == 2


def test_rates_are_drawn_with_their_bounds_and_the_target() -> None:
    figure = plots.rates([("control", 1e-9, 1e-8), ("planning", 0.0, 1e-10)], 1e-7)
    (axis,) = figure.axes
    assert [label.get_text() for label in axis.get_yticklabels()] == ["control", "planning"]
    assert axis.get_xlim()[1] > 1e-7
    ends = [list(np.asarray(line.get_xdata())) for line in axis.lines]
    assert [1e-9, 1e-8] in ends
    assert [0.0] not in ends


def test_the_same_figure_is_the_same_svg() -> None:
    found = {"a": [(0.0, 1.0), (1.0, 2.0), (2.0, None)]}
    first, second = (plots.svg(plots.lines("lines", "x", "y", found)) for _ in range(2))
    assert first == second
    assert "clip-path" in first
