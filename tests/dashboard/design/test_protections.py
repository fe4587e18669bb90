"""Which arms protect the vehicle that a budget is of, and what is refused in one clear line."""

import pytest

from dashboard.campaigns.spec import Arm, CampaignSpec, Condition
from dashboard.design.protections import combined, flown_arms
from deploy.errors import BadSpecError
from services.models.mission import MissionSpec
from tests.dashboard.design.synthetic import BARE, BUDGET, DETECTOR, GUARD, PID, SPEC, changed, element, flown

OTHER = {"detector": {"scheme": "kinematic"}}


def found(spec: CampaignSpec) -> list[str]:
    return [one.name for one in flown_arms(BUDGET, [flown(spec)]).protections]


def test_arms_that_only_protect_are_the_options() -> None:
    arms = flown_arms(BUDGET, [flown(SPEC)])
    assert [one.name for one in arms.protections] == ["finite", "gaussian"]
    assert arms.arms == {("options-1", "bare")}
    assert [one.fault.target for one in arms.elements] == ["pid", "trajectory.position"]
    assert arms.protections[0].cells["way"] == ("options-1", "finite", "way")


def test_two_arms_of_one_protection_are_one_and_a_taken_name_says_its_campaign() -> None:
    arms = [*SPEC.arms, Arm(name="again", mission=GUARD), Arm(name="TMR", mission=OTHER)]
    assert found(changed(SPEC, arms)) == ["finite", "gaussian", "options-1/TMR"]


def test_an_arm_of_another_vehicle_or_without_a_guard_is_left_out_and_told() -> None:
    fewer = Arm(name="fewer", mission={"guards": ["clip"]})
    other = Arm(name="other planner", mission={"planner": "prm"})
    arms = flown_arms(BUDGET, [flown(changed(SPEC, [*SPEC.arms, fewer, other]))])
    assert arms.left_out == ("options-1 / fewer: without restart", "options-1 / other planner: other planner")


def test_a_protection_without_a_bare_arm_is_refused() -> None:
    alone = Arm(name="alone", mission={"planner": "prm", **DETECTOR})
    with pytest.raises(BadSpecError, match=r"arm 'alone' has no bare arm beside it.*planner, detector"):
        found(changed(SPEC, [*SPEC.arms, alone]))
    beside = Arm(name="prm", mission={"planner": "prm"})
    assert found(changed(SPEC, [*SPEC.arms, alone, beside])) == ["finite", "gaussian"]


def test_an_element_without_a_cell_or_without_a_bare_one_is_refused() -> None:
    for one, told in (
        (element("pid", fault="pdi"), "no such cell"),
        (element("pid", arm="gaussian"), "arm 'gaussian' has a detector; name the arm without one"),
        (element("pid", arm=""), "name one of"),
    ):
        budget = BUDGET.model_copy(update={"elements": (one,)})
        with pytest.raises(BadSpecError, match=f"element 'pid'.*{told}"):
            flown_arms(budget, [flown(SPEC)])


def test_elements_of_two_vehicles_are_refused() -> None:
    arms = [*SPEC.arms, Arm(name="prm", mission={"planner": "prm"})]
    budget = BUDGET.model_copy(update={"elements": (element("pid"), element("way", arm="prm"))})
    with pytest.raises(BadSpecError, match=r"'way'.*other planner; a design is of one vehicle"):
        flown_arms(budget, [flown(changed(SPEC, arms))])


def test_a_protection_that_did_not_fly_a_fault_is_refused() -> None:
    arms = [
        Arm(name="bare", fault=PID),
        Arm(name="bare way", fault=SPEC.faults[1].fault),
        Arm(name="finite", mission=GUARD, fault=PID),
    ]
    spec = CampaignSpec(name="own", runs=9, mission=BARE, arms=tuple(arms))
    elements = (element("pid", fault=""), element("way", arm="bare way", fault=""))
    budget = BUDGET.model_copy(update={"elements": elements})
    with pytest.raises(BadSpecError, match="arm 'finite' did not fly the fault of element 'way'"):
        flown_arms(budget, [flown(spec)])


def test_a_cell_without_a_fault_is_refused() -> None:
    spec = changed(SPEC, SPEC.arms, faults=(Condition(name="pid", fault=PID), Condition(name="way")))
    campaign, runs = flown(SPEC)
    with pytest.raises(BadSpecError, match="flies without a fault"):
        flown_arms(BUDGET, [(type(campaign)(1, spec, "done", "", ""), runs)])


def test_what_is_combined_has_every_guard_one_pilot_and_one_detector() -> None:
    def mission(**fields: object) -> MissionSpec:
        return MissionSpec.model_validate(BARE.model_dump(exclude_unset=True) | fields)

    order = {"guards": ["clip", "order", "restart"]}
    assert combined(BARE, []) == {}
    assert combined(BARE, [mission(**GUARD), mission(**order), mission(**DETECTOR)]) == {
        "guards": ["clip", "finite", "order", "restart"],
        **DETECTOR,
    }
    assert combined(BARE, [mission(pilot="guarded"), mission(**GUARD)]) == {"pilot": "guarded"}
    assert combined(BARE, [mission(**OTHER), mission(**DETECTOR)]) is None
