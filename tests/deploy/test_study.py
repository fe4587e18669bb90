"""Faults in kernels alone: classified, repeatable in what is drawn, nothing left behind, nonsense refused."""

import os

import pytest

from deploy.check import BadSpecError
from deploy.study import check_study, study
from services.bus.mission import FaultSpec
from tests.conftest import descendants

INJECTIONS = 24


def test_every_injection_is_classified_and_the_slots_change_nothing_that_is_drawn() -> None:
    fault = FaultSpec(target="rrt", register_class="gpr")
    runs = sorted(study("rrt", fault, INJECTIONS, 1, 2), key=lambda one: one.index)
    assert [one.index for one in runs] == list(range(INJECTIONS))
    for one in runs:
        assert (one.result == "not_injected") == (one.injection.status != "injected")
        if one.injection.status == "injected":
            assert one.injection.before != one.injection.after == one.injection.read_back
    # A flipped pointer kills, a flipped number in a dead register does nothing.
    assert {"benign", "crash"} <= {one.result for one in runs}
    assert all(one.cause for one in runs if one.result == "crash")
    assert not descendants(os.getpid()) or "zenfi" not in str(descendants(os.getpid()))


def test_without_the_flip_all_is_benign() -> None:
    fault = FaultSpec(target="pid", model="none")
    runs = list(study("pid", fault, 8, 1, 1))
    assert {one.result for one in runs} == {"not_injected"}
    assert {one.injection.status for one in runs} <= {"not_activated", "not_reached"}


def test_a_stuck_register_leads_to_a_crash_or_a_hang_that_is_ended() -> None:
    fault = FaultSpec(target="pid", model="stuck_at", stuck_value=1, stuck_instructions=200)
    runs = list(study("pid", fault, 8, 2, 1))
    assert len(runs) == 8


def test_an_unknown_kernel_is_refused() -> None:
    with pytest.raises(BadSpecError, match="unknown kernel 'wings'; known: point_cloud"):
        check_study(["wings"])
