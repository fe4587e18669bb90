"""What a campaign plans: cells, seeds, and what it refuses."""

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from dashboard.campaigns.executors.spec import DaskSpec
from dashboard.campaigns.spec import Arm, CampaignSpec, Cell, cells, counted, load_campaign, runs
from deploy.errors import BadSpecError

GOLDEN = {"name": "golden"}
FLIP = {"name": "flip", "fault": {"target": "pid"}}


def spec(**fields: Any) -> CampaignSpec:
    return CampaignSpec.model_validate({"name": "x", "runs": 2, "arms": [GOLDEN], **fields})


def test_cells_are_arms_times_worlds_times_faults() -> None:
    campaign = spec(
        arms=[{"name": "a"}, {"name": "b", "mission": {"planner": "rrt"}}],
        worlds=["sparse", "dense"],
        faults=[{"name": "none"}, FLIP],
    )
    assert len(cells(campaign)) == 8
    assert Cell("b", "dense", "flip") in cells(campaign)
    flown = list(runs(campaign))
    assert len(flown) == 16
    last = flown[-1]
    assert (last.cell, last.index) == (("b", "dense", "flip"), 1)
    assert last.spec.planner == "rrt"
    assert last.spec.fault is not None
    assert last.spec.fault.seed == 1
    assert flown[0].spec.fault is None


def test_an_arm_changes_only_what_it_names() -> None:
    arms = [{"name": "a", "mission": {"limits": {"restarts": 0}, "profile": "paper"}}]
    campaign = spec(mission={"limits": {"mission_time_s": 5.0}, "platform": "tx2"}, arms=arms)
    mission = next(iter(runs(campaign))).spec
    assert mission.limits.restarts == 0
    assert mission.limits.mission_time_s == 5.0
    assert mission.platform == "tx2"
    assert mission.camera.width == 256


def test_arms_fly_the_same_seeds() -> None:
    seeds = [(run.arm, run.spec.seed) for run in runs(spec(mission={"seed": 5}, arms=[GOLDEN, FLIP]))]
    assert seeds == [("golden", 5), ("flip", 5), ("golden", 6), ("flip", 6)]


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"runs": 6, "seeds": 2, "arms": [GOLDEN, FLIP]},
        {"runs": 5, "arms": [FLIP]},
        {
            "runs": 5,
            "seeds": 3,
            "arms": [GOLDEN],
            "worlds": ["sparse", "dense"],
            "faults": [{"name": "none"}, FLIP],
        },
        {"runs": 4, "seeds": 2, "mission": {"clock": "realtime"}, "arms": [GOLDEN, FLIP]},
        {
            "arms": [
                FLIP,
                {"name": "other", "fault": {"target": "octomap"}, "mission": {"planner": "rrt"}},
                GOLDEN,
            ]
        },
    ],
)
def test_runs_and_twins_are_counted_as_they_are_planned(fields: dict[str, Any]) -> None:
    campaign = spec(**fields)
    planned = list(runs(campaign))
    golden = {run.spec.model_dump_json() for run in planned if run.spec.fault is None}
    twins = {run.twin.model_dump_json() for run in planned if run.spec.fault is not None}
    assert counted(campaign) == (len(planned), len(twins - golden))


def test_flights_that_would_repeat_are_flown_once() -> None:
    campaign = spec(runs=6, seeds=2, arms=[GOLDEN, FLIP])
    golden = [run.spec.seed for run in runs(campaign) if run.arm == "golden"]
    flips = [(run.spec.seed, run.spec.fault.seed) for run in runs(campaign) if run.spec.fault is not None]
    assert golden == [0, 1]
    assert flips == [(0, 0), (1, 1), (0, 2), (1, 3), (0, 4), (1, 5)]


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"wings": 2}, "wings"),
        ({"runs": 10**9}, "runs"),
        ({"runs": 60_000, "arms": [GOLDEN, FLIP]}, "runs: 120000 flights"),
        ({"arms": []}, "arms"),
        ({"arms": [GOLDEN, GOLDEN]}, "same name: golden"),
        ({"worlds": ["sparse", "sparse"]}, "worlds"),
        ({"faults": [FLIP], "arms": [FLIP]}, "arms: a fault"),
        ({"mission": {"fault": {"target": "pid"}}}, "mission.fault"),
        ({"seeds": 3}, "seeds"),
        ({"mission": {"seed": 2**32 - 1}}, "mission.seed"),
        ({"arms": [{"name": "a", "mission": {"wings": 2}}]}, "wings"),
        ({"arms": [{"name": "a", "mission": {"seed": 2}}]}, "seed is not an arm's"),
        ({"stop": {"margin": 0.1, "looks": [5, 1]}, "runs": 9}, "stop.looks"),
        ({"stop": {"margin": 0.1, "looks": [2]}}, "stop.looks"),
        ({"stop": {"margin": 0.0, "looks": [1]}}, "margin"),
        ({"stop": {"looks": [1]}, "runs": 9}, "margin or relative"),
        ({"stop": {"margin": 0.1, "relative": 0.1, "looks": [1]}, "runs": 9}, "margin or relative"),
        ({"stop": {"relative": 0.1, "of": "luck", "looks": [1]}, "runs": 9}, "of"),
        ({"artefacts": "../elsewhere"}, "artefacts"),
        ({"artefacts": "/etc"}, "artefacts"),
        ({"limits": {"attempts": 0}}, "attempts"),
        ({"recording": {"keep": "some"}}, "keep"),
        ({"recording": {"keep": "sample", "sample": 0}}, "sample"),
        ({"recording": {"disk_mb": 0}}, "disk_mb"),
    ],
)
def test_what_cannot_be_is_refused_by_name(fields: dict[str, Any], says: str) -> None:
    with pytest.raises(ValidationError) as refusal:
        spec(**fields)
    assert says in str(refusal.value)


def test_a_fault_on_a_missing_kernel_is_refused_with_its_place(tmp_path: Path) -> None:
    path = tmp_path / "bad.json"
    path.write_text('{"name": "x", "runs": 1, "arms": [{"name": "a", "fault": {"target": "teapot"}}]}')
    with pytest.raises(BadSpecError, match=r"arms: a: .*teapot"):
        load_campaign(str(path))


@pytest.mark.parametrize("place", ["arms", "faults"])
def test_a_histogram_is_kept_with_its_content(place: str, tmp_path: Path) -> None:
    histogram = tmp_path / "upsets.toml"
    histogram.write_text("[bits]\n2 = 0.25\n1 = 0.75\n")
    path = tmp_path / "campaign.toml"
    fault = f'{{target = "pid", mask = "histogram", histogram = "{histogram}"}}'
    golden = '[[arms]]\nname = "a"\n' if place == "faults" else ""
    path.write_text(f'name = "x"\nruns = 1\n{golden}[[{place}]]\nname = "b"\nfault = {fault}\n')
    campaign = load_campaign(str(path))
    histogram.unlink()
    again = CampaignSpec.model_validate_json(campaign.model_dump_json())
    (fault_of,) = [run.spec.fault for run in runs(again) if run.spec.fault is not None]
    assert fault_of.histogram is not None
    assert fault_of.histogram.bits == {1: 0.75, 2: 0.25}


def test_presets_can_be_flown() -> None:
    assert load_campaign("demo").name == "demo"


def test_where_it_is_flown_goes_with_what_was_set_alone() -> None:
    """As the client sends it."""
    at = DaskSpec(address="tcp://127.0.0.1:8786")
    campaign = CampaignSpec(name="x", runs=1, arms=(Arm(name="a"),), executor=at)
    assert CampaignSpec.model_validate_json(campaign.model_dump_json(exclude_unset=True)) == campaign
