"""Designs are all combinations of options; what each leaves agrees with what is reckoned by hand."""

from dataclasses import replace

import numpy as np
import pytest

from dashboard.campaigns.spec import Condition
from dashboard.design.designs import DesignChoice, DesignSpace, EvaluatedDesign, front
from dashboard.design.overheads import ProtectionCost, RelativeOverhead
from dashboard.design.paired_strikes import BARE, PairedStrikes
from dashboard.design.protections import NOTHING, flown_arms
from dashboard.design.second_computer import second_computers
from dashboard.evidence.ledger import StrikeCounts, reckon
from deploy.errors import BadSpecError
from sim.vehicle.redundancy import RedundancyStudy
from tests.dashboard.design.synthetic import BUDGET, MOTOR, PID, SPEC, changed, element, flown


def strikes(bare: int, finite: int, gaussian: int, of: int = 200) -> PairedStrikes:
    """So many of the first strikes harm."""

    def first(harmed: int) -> np.ndarray[tuple[int], np.dtype[np.int8]]:
        return (np.arange(of) < harmed).astype(np.int8)

    harm = {BARE: first(bare), "finite": first(finite), "gaussian": first(gaussian)}
    return PairedStrikes(StrikeCounts(of, bare + 1, bare), harm)


def cost(time: float) -> ProtectionCost:
    part = RelativeOverhead(mean=time, low=time - 0.003, high=time + 0.004)
    return ProtectionCost(pairs=9, arrived=9, lost=0, lost_high=0.3, flight_time=part, energy=part)


def space(finite: float = 0.01) -> DesignSpace:
    return DesignSpace(
        BUDGET,
        flown_arms(BUDGET, [flown(SPEC)]),
        [strikes(60, 40, 10), strikes(100, 20, 30)],
        {"finite": cost(finite), "gaussian": cost(0.04)},
        second_computers(RedundancyStudy()),
    )


def design(*options: str) -> DesignChoice:
    found = {one.options: one for one in space().enumerate().choices}
    return found[options]


def test_every_combination_is_there_once() -> None:
    listed = space().enumerate()
    # Five options of two elements; DMR with TMR is no design.
    assert (listed.combinations, listed.impossible, listed.pruned) == (25, 2, ())
    vehicles = {(one.protections, one.scheme, one.masked) for one in listed.choices}
    # Without computers the four subsets; with either of them three patterns, one or the other element open.
    assert len(vehicles) == len(listed.choices) == 4 + 2 * (3 + 3 + 1)


def test_two_detectors_exclude_each_other() -> None:
    arms = [
        *SPEC.arms,
        SPEC.arms[2].model_copy(update={"name": "own", "mission": {"detector": {"scheme": "kinematic"}}}),
    ]
    two = flown_arms(BUDGET, [flown(changed(SPEC, arms))])
    known = [
        replace(one, harm={**one.harm, "own": one.harm[BARE]}) for one in (strikes(9, 9, 9), strikes(9, 9, 9))
    ]
    costs = dict.fromkeys(("finite", "gaussian", "own"), cost(0.0))
    assert DesignSpace(BUDGET, two, known, costs, {}).enumerate().impossible == 2


def test_a_worked_example_agrees_to_nine_digits() -> None:
    one = space().evaluate(design("finite", "gaussian"))
    # 100e-9 * 2 * 0.5 * 10 / 200 and 40e-9 * 2 * 0.5 * 20 / 200: the first 10 and 20 strikes harm in both
    assert one.rate_per_hour == pytest.approx(5e-9 + 4e-9, rel=1e-9)
    assert one.counts == ((200, 200, 10), (200, 200, 20))
    assert one.flight_time.mean == pytest.approx(0.05, rel=1e-9)
    assert one.flight_time.low == pytest.approx(0.05 - 0.003 * 2**0.5, rel=1e-9)
    assert one.mass_kg == 0.0
    # What is on for the second element is on for the first, too: 100e-9 * 10 / 200.
    assert space().evaluate(design(NOTHING, "gaussian")).rate_per_hour == pytest.approx(5e-9 + 6e-9, rel=1e-9)


def test_the_bare_design_has_the_bound_of_the_ledger() -> None:
    bare = space().evaluate(design(NOTHING, NOTHING))
    ledger = reckon(BUDGET, [StrikeCounts(200, 61, 60), StrikeCounts(200, 101, 100)])
    assert (bare.rate_per_hour, bare.bound_per_hour) == (ledger.rate_per_hour, ledger.bound_per_hour)


def test_a_further_computer_masks_its_elements_and_weighs() -> None:
    part, whole = (space().evaluate(design(*names)) for names in (("TMR", "finite"), ("TMR", "TMR")))
    assert part.counts == (None, (200, 200, 20))
    assert part.rate_per_hour == pytest.approx(4e-9, rel=1e-9)
    assert (whole.rate_per_hour, whole.bound_per_hour) == (0.0, 0.0)
    assert whole.mass_kg == pytest.approx(0.17)
    assert part.flight_time.mean == pytest.approx(0.01 + whole.flight_time.mean, rel=1e-9)


def test_too_many_combinations_lose_options_that_others_beat_and_then_are_refused() -> None:
    # Slower than the detector and worse on the first element, where it goes; on the second it leaves less.
    listed = space(finite=0.05).enumerate(limit=24)
    assert listed.pruned == (("pid", "finite"), ("pid", "TMR"), ("way", "TMR"))
    assert listed.combinations == 3 * 4
    with pytest.raises(BadSpecError, match="12 combinations of options, at most 11 are evaluated: leave out"):
        space(finite=0.05).enumerate(limit=11)


def test_a_motor_has_no_second_computer() -> None:
    spec = changed(
        SPEC, SPEC.arms, faults=(Condition(name="pid", fault=PID), Condition(name="motor", fault=MOTOR))
    )
    budget = BUDGET.model_copy(update={"elements": (element("pid"), element("motor"))})
    campaign, runs = flown(SPEC)
    named = [
        replace(one, cell=one.cell._replace(fault="motor")) if one.cell.fault == "way" else one
        for one in runs
    ]
    arms = flown_arms(budget, [(replace(campaign, spec=spec), named)])
    found = DesignSpace(budget, arms, [], {}, second_computers(RedundancyStudy()))
    assert found.options[1] == (NOTHING, "finite", "gaussian")


def test_the_front_is_what_no_other_design_beats() -> None:
    def made(bound: float, time: float, mass: float = 0.0, *on: str) -> EvaluatedDesign:
        choice = DesignChoice(on, on, "", ())
        both = RelativeOverhead(mean=time)
        return EvaluatedDesign(choice, (), bound, bound, both, both, mass)

    best = [made(1.0, 0.2), made(2.0, 0.1), made(3.0, 0.0)]
    heavier = made(0.5, 0.3, 0.1)
    beaten = [made(2.0, 0.15), made(3.5, 0.0), made(1.0, 0.2, 0.0, "a")]
    assert front([*beaten, *best, heavier]) == [heavier, *best]


def test_the_front_of_many_is_that_of_every_pair() -> None:
    draw = np.random.default_rng(5)
    many = [
        EvaluatedDesign(
            DesignChoice((str(place),), (), "", ()),
            (),
            0.0,
            *(float(axes[0]), RelativeOverhead(mean=axes[1]), RelativeOverhead(mean=axes[2]), float(axes[3])),
        )
        for place, axes in enumerate(draw.integers(0, 4, (120, 4)))
    ]
    axes = {one.axes for one in many}
    slow = {
        one
        for one in axes
        if not any(o != one and all(a <= b for a, b in zip(o, one, strict=True)) for o in axes)
    }
    assert {one.axes for one in front(many)} == slow
    assert len(front(many)) == len(slow)
