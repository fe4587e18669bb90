"""The campaigns that come along: the paper's cells, flyable, at any scale."""

import json
from collections import Counter
from contextlib import closing
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from dashboard.analysis import tables
from dashboard.campaigns.forecast import forecast
from dashboard.campaigns.presets import presets, scaled
from dashboard.campaigns.spec import CampaignSpec, cells, load_campaign, runs
from dashboard.campaigns.store.store import Store
from deploy.errors import BadSpecError
from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from services.models.world import ForestWorld, GatesWorld, TrafficWorld
from tests.dashboard.command import zenfi

PAPER = {"table1": 4, "fig7": 8, "fig8": 9, "fig9": 4, "table3": 4, "table4": 48, "fig14": 33, "fig16": 54}
"""Cells of each."""

OURS = ("demo", "difficulty", "guards", "harmful", "kernel-vs-system", "recovery", "recurrence", "wind")


@pytest.mark.parametrize(("name", "count"), PAPER.items())
def test_a_preset_has_the_papers_cells_and_a_hundred_flights_in_each(name: str, count: int) -> None:
    campaign = load_campaign(name)
    assert campaign.name == name
    flown = Counter(run.cell for run in runs(campaign))
    assert len(flown) == len(cells(campaign)) == count
    assert set(flown.values()) == {100}


def test_detectors_are_asked_for_where_the_paper_has_them() -> None:
    schemes = {
        run.arm: run.spec.detector.scheme if run.spec.detector is not None else None
        for run in runs(scaled(load_campaign("table4"), 0.01))
    }
    assert schemes == {"bare": None, "gaussian": "gaussian", "autoencoder": "autoencoder"}
    scopes = {run.arm: run.spec.detector for run in runs(scaled(load_campaign("fig14"), 0.01))}
    assert {one.recovery for one in scopes.values() if one is not None} == {
        "perception",
        "planning",
        "control",
        "planning_control",
        "all",
    }


def test_all_are_listed_in_a_line_each_with_what_they_take(tmp_path: Path) -> None:
    with closing(Store(tmp_path)) as store:
        plans = [(one, forecast(load_campaign(one.name), store, 2)) for one in presets()]
    assert {one.name for one, _ in plans} == {*PAPER, *OURS}
    assert {one.name: plan.cells for one, plan in plans if one.name in PAPER} == PAPER
    # Twins that fly as cells of their own are not flown again.
    assert {one.name: plan.twins for one, plan in plans}["table4"] == 0
    paper = Console(file=StringIO(), width=80)
    paper.print(tables.presets(plans))
    assert isinstance(paper.file, StringIO)
    assert len(paper.file.getvalue().splitlines()) == len(plans) + 1


def test_difficulty_flies_both_pilots_from_easy_to_hard_without_a_fault() -> None:
    flown = list(runs(load_campaign("difficulty")))
    grades: dict[tuple[str, str], list[float]] = {}
    for run in flown:
        world = run.spec.world
        assert isinstance(world, ForestWorld | GatesWorld | TrafficWorld)
        grades.setdefault((world.kind, run.spec.pilot), []).append(world.difficulty)
    assert set(grades) == {
        (kind, pilot) for kind in ("forest", "gates", "traffic") for pilot in ("guarded", "baseline")
    }
    assert all(set(given) == {0.0, 0.25, 0.5, 0.75, 1.0} for given in grades.values())
    assert {run.spec.fault for run in flown} == {None}


def test_wind_rises_to_where_the_vehicle_hardly_holds() -> None:
    winds = {run.spec.wind.mean_m_s[0] for run in runs(load_campaign("wind"))}
    assert winds == {0.0, -8.0, -12.0, -16.0}


@pytest.mark.parametrize(("factor", "expected"), [(0.1, 10), (0.001, 1), (0.125, 12), (3, 300)])
def test_a_scale_multiplies_runs_and_keeps_pairs(factor: float, expected: int) -> None:
    seeds: dict[str, list[int]] = {}
    for run in runs(scaled(load_campaign("fig9"), factor)):
        seeds.setdefault(run.arm, []).append(run.spec.seed)
    assert set(map(tuple, seeds.values())) == {tuple(range(expected))}


def test_a_scale_moves_seeds_and_looks_along() -> None:
    stop = {"margin": 0.1, "looks": [2, 20, 100]}
    arms = [{"name": "a", "fault": {"target": "pid"}}]
    campaign = CampaignSpec.model_validate(
        {"name": "x", "runs": 200, "seeds": 50, "arms": arms, "stop": stop}
    )
    tenth = scaled(campaign, 0.1)
    assert (tenth.runs, tenth.seeds) == (20, 5)
    assert tenth.stop is not None
    assert tenth.stop.looks == (1, 2, 10)
    least = scaled(campaign, 0.001)
    assert (least.runs, least.seeds, least.stop) == (1, 1, None)
    with pytest.raises(BadSpecError, match=r"scale 1000: .*runs"):
        scaled(campaign, 1000)


@pytest.mark.soak
def test_a_preset_is_flown_by_its_name(home: Path) -> None:
    answer = zenfi("campaign", "run", "fig9", "--scale", "0.01", "--json")
    assert answer.returncode == 0, answer.stderr
    *_, last = map(json.loads, answer.stdout.splitlines())
    assert [line["arm"] for line in last["summary"]] == ["golden", "sign", "exponent", "mantissa"]
    assert [(line["planned"], line["runs"]) for line in last["summary"]] == [(1, 1)] * 4
    assert [line["aimed"] for line in last["summary"]] == [0, 1, 1, 1]
    assert home.is_dir()


@pytest.mark.soak
def test_a_preset_with_detectors_can_be_flown(server: ForkServer) -> None:
    cell = ("gaussian all", "factory", "control")
    run = next(run for run in runs(load_campaign("fig14")) if run.cell == cell)
    outcome = PairFlyer(server).fly(run.spec)
    assert outcome.golden is not None
    assert outcome.injection is not None
