"""From a store's campaigns to designs, a folder of files, and a check of what is flown then."""

import csv
import json
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import pytest

from dashboard.campaigns.spec import Arm, CampaignSpec, load_campaign
from dashboard.campaigns.store.store import Store
from dashboard.design import report
from dashboard.design.check import check_designs
from dashboard.design.document import DesignStudy, read_design_study
from dashboard.design.gather import DesignRequest, study_designs
from dashboard.evidence.budget import UpsetBudget
from dashboard.evidence.counts import strikes_of
from dashboard.evidence.ledger import reckon
from deploy.errors import BadSpecError
from tests.dashboard.design.synthetic import BUDGET, SPEC, TRUTH, Truth, changed, stored

TARGET = BUDGET.model_copy(update={"target_per_hour": 4e-8, "assumptions": ("Registers have no parity.",)})


class Studied(NamedTuple):
    """A store with a campaign, what was found of it, and the folder that was written."""

    store: Store
    found: DesignStudy
    campaigns: dict[str, CampaignSpec]
    folder: Path


@pytest.fixture(scope="module")
def studied(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studied]:
    folder = tmp_path_factory.mktemp("designs")
    with closing(Store(folder)) as store:
        found, campaigns = study_designs(store, [stored(store, SPEC)], DesignRequest(TARGET, flights=60))
        report.write(folder / "out", found, campaigns)
        yield Studied(store, found, campaigns, folder / "out")


def test_the_bare_design_is_the_ledger_of_the_evidence(studied: Studied) -> None:
    campaign = studied.store.find("options-1")
    flown = [(campaign, list(studied.store.records(campaign)))]
    ledger = reckon(TARGET, [strikes_of(one, flown).counts for one in TARGET.elements])
    bare = studied.found.bare
    assert (bare.rate_per_hour, bare.bound_per_hour) == (ledger.rate_per_hour, ledger.bound_per_hour)
    assert bare.name == "design-00"
    assert not bare.meets_target


def test_options_have_intervals_around_what_is_true(studied: Studied) -> None:
    true = {
        ("pid", "nothing"): 0.3,
        ("pid", "finite"): 0.3 * 0.8,
        ("pid", "gaussian"): 0.3 * 0.4,
        ("way", "nothing"): 0.5,
        ("way", "finite"): 0.5 * 0.3,
        ("way", "gaussian"): 0.5 * 0.6,
    }
    for one in studied.found.options:
        if one.masked:
            assert (one.residual, one.low, one.struck) == (0.0, None, 0)
            continue
        assert one.low is not None
        assert one.high is not None
        assert one.low <= true[one.element, one.option] <= one.high
        if one.option != "nothing":
            assert one.difference is not None
            assert one.difference < 0


def test_costs_are_those_that_are_true(studied: Studied) -> None:
    finite, gaussian = studied.found.protections
    assert (finite.cost.flight_time.mean, gaussian.cost.flight_time.mean) == pytest.approx((0.01, 0.04))
    assert (finite.cost.energy.mean, gaussian.cost.energy.mean) == pytest.approx((0.02, 0.08))
    assert (finite.check_share, finite.cost.pairs) == (None, 200)
    assert gaussian.check_share is not None
    assert (gaussian.check_share.mean, gaussian.check_share.low) == (0.015625, 0.015625)


def test_the_files_say_what_was_found(studied: Studied) -> None:
    assert read_design_study(studied.folder) == studied.found
    page = (studied.folder / report.PAGE).read_text()
    best = next(one for one in studied.found.front if one.protections)
    assert f"| {best.name} | {report.options(best)} | {best.rate_per_hour:.3g} |" in page
    assert "- Registers have no parity.\n" in page
    assert "0 (assumed)" in page
    assert "is the quickest" in page
    with (studied.folder / report.TABLE).open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["design"] for row in rows] == [one.name for one in studied.found.front]
    assert float(rows[-1]["bound_per_hour"]) == studied.found.front[-1].bound_per_hour
    assert "<svg" in (studied.folder / report.FIGURE).read_text()
    for name, spec in studied.campaigns.items():
        assert load_campaign(str(studied.folder / f"campaigns/{name}.toml")) == spec


def test_five_designs_are_flown_and_lie_inside_and_one_that_is_not_so_lies_outside(studied: Studied) -> None:
    assert len(studied.campaigns) >= 5
    flown = [stored(studied.store, spec) for spec in studied.campaigns.values()]
    together = [(one, list(studied.store.records(one))) for one in flown]
    found = check_designs(studied.folder, together)
    assert [one.design for one in found] == list(studied.campaigns)
    assert all(one.inside for one in found)
    assert {one.level for one in found} == {1 - 0.05 / len(found)}
    assert all(0 < one.strikes <= 120 and one.flown_low <= one.flown <= one.flown_high for one in found)
    worse = replace(TRUTH, averts={})
    name, spec = next((one, spec) for one, spec in studied.campaigns.items() if spec.arms[0].mission)
    again = stored(studied.store, spec, worse)
    (one,) = check_designs(studied.folder, [(again, list(studied.store.records(again)))])
    assert (one.design, one.inside, one.in_flown_interval, one.level) == (name, False, False, 0.95)


def test_what_is_not_the_design_is_refused(studied: Studied) -> None:
    name, spec = next((one, spec) for one, spec in studied.campaigns.items() if len(spec.faults) == 2)
    mission = spec.mission.model_copy(update={"seed": 3})
    for other, told in (
        (SPEC, "none of its arms .* is a design of"),
        (
            spec.model_copy(update={"arms": (Arm(name=name, mission={"planner": "prm"}),)}),
            "flies the mission",
        ),
        (spec.model_copy(update={"faults": spec.faults[:1]}), "flies fault '2 way' otherwise"),
        (spec.model_copy(update={"worlds": ("dense",)}), "flies its worlds otherwise"),
        (spec.model_copy(update={"mission": mission}), "flies its seeds otherwise"),
    ):
        entry = replace(studied.store.find("options-1"), spec=other)
        with pytest.raises(BadSpecError, match=told):
            check_designs(studied.folder, [(entry, [])])
    nothing = stored(studied.store, spec, Truth(harm=TRUTH.harm, averts={}, strikes=0.0))
    with pytest.raises(BadSpecError, match="has no strike yet"):
        check_designs(studied.folder, [(nothing, list(studied.store.records(nothing)))])


def test_folders_without_a_study_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadSpecError, match="No such file"):
        read_design_study(tmp_path)
    (tmp_path / "design.json").write_text(json.dumps({"name": "else"}))
    with pytest.raises(BadSpecError, match="no designs; zenfi study design"):
        read_design_study(tmp_path)


def test_elements_of_other_worlds_are_refused(studied: Studied) -> None:
    dense = stored(studied.store, changed(SPEC, SPEC.arms, name="dense", runs=4, worlds=("dense",)))
    pid, way = TARGET.elements
    elements = (
        pid.model_copy(update={"campaign": "options-1"}),
        way.model_copy(update={"campaign": dense.label}),
    )
    budget: UpsetBudget = TARGET.model_copy(update={"elements": elements})
    with pytest.raises(BadSpecError, match="flies other worlds than options-1"):
        study_designs(studied.store, [studied.store.find("options-1"), dense], DesignRequest(budget))
