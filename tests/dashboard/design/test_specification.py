"""A design's campaign flies all that it has on, on seeds of its own, and its file says the same."""

import tomllib
from pathlib import Path

import pytest

from dashboard.campaigns.spec import Arm, CampaignSpec, Condition, load_campaign
from dashboard.design.protections import flown_arms
from dashboard.design.specification import design_campaign, fault_name, to_toml
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec
from tests.dashboard.design.synthetic import BUDGET, DETECTOR, SPEC, changed, flown


def made(spec: CampaignSpec, changes: dict[str, object]) -> CampaignSpec:
    arms = flown_arms(BUDGET, [flown(spec)])
    faults = {fault_name(place, one.element.name): one for place, one in enumerate(arms.elements)}
    return design_campaign("design-07", arms.mission, changes, faults, {"options-1": spec}, 30)


def test_no_seed_is_flown_again() -> None:
    mission = MissionSpec(pilot="baseline", seed=50)
    spec = changed(SPEC, SPEC.arms, mission=mission, worlds=("sparse", "dense"), runs=9, seeds=3)
    found = made(spec, dict(DETECTOR))
    assert (found.runs, found.seeds, found.mission.seed, found.worlds) == (30, None, 59, ("sparse", "dense"))
    assert [one.fault.seed for one in found.faults if one.fault is not None] == [9, 9]
    assert [one.name for one in found.faults] == ["1 pid", "2 way"]
    assert found.mission.pilot == "baseline"
    assert found.arms == (Arm(name="design-07", mission=DETECTOR),)


def test_nor_is_one_of_a_longer_campaign_of_a_protection() -> None:
    arms = flown_arms(BUDGET, [flown(SPEC)])
    sources = {"options-1": SPEC, "more-2": changed(SPEC, SPEC.arms, name="more", runs=500)}
    found = design_campaign("design-07", arms.mission, {}, {"1 pid": arms.elements[0]}, sources, 30)
    assert found.mission.seed == 500
    assert found.faults[0].fault is not None
    assert found.faults[0].fault.seed == 500


@pytest.mark.process
def test_the_file_is_the_campaign(tmp_path: Path) -> None:
    for spec in (made(SPEC, {}), made(SPEC, dict(DETECTOR))):
        (tmp_path / "design.toml").write_text(to_toml(spec, ["a line", ""]))
        assert load_campaign(str(tmp_path / "design.toml")) == spec


def test_whatever_a_model_holds_is_read_back() -> None:
    told = {"a": [1, 2.5, 1e-9, True], "b c": {'ü"\\\x7f\n': "\t", "é": -3}, "d": {}}
    mission = {"detector": {"scheme": "gaussian", "model": told | {"none": None}}}
    spec = CampaignSpec(
        name="design-07",
        runs=3,
        mission=MissionSpec(seed=2, properties=("always deviation <= 0.01",)),
        arms=(Arm(name="design-07", mission=mission),),
        worlds=("sparse",),
        faults=(Condition(name="1 pid", fault=FaultSpec(target="pid", bit_numbers=(3, 4))),),
    )
    found = CampaignSpec.model_validate(tomllib.loads(to_toml(spec, [])))
    assert found.arms[0].mission["detector"]["model"] == told
    assert found.model_copy(update={"arms": spec.arms}) == spec
