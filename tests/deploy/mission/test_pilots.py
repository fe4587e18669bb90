"""Both pilots in real flights, and what a guard that is switched off lets through."""

from dataclasses import replace

import pytest

from deploy.config.processes import STACK
from deploy.mission.flight import fly
from deploy.mission.fork_server import ForkServer
from services.models.faults.specification import FaultSpec, Trigger
from services.models.mission import MissionSpec
from services.models.outcome import Outcome
from services.models.pilots import ALL_GUARDS

QUICK = {"take_off_s": 1.0, "look_round_s": 2.0, "plan_wait_s": 1.0}
NO_NUMBER = FaultSpec(
    level="source",
    target="collision_check.time_to_collision",
    bit_numbers=(0,),
    trigger=Trigger(invocation=3),
)
"""No collision is infinity, and infinity with one more bit is not a number."""

ASTRAY = FaultSpec(
    level="source", target="trajectory.x", point=5, bit_numbers=(59,), trigger=Trigger(invocation=1)
)


def flown(server: ForkServer, **fields: object) -> Outcome:
    given = {"seed": 1, "pace": QUICK, "limits": {"mission_time_s": 45.0}, **fields}
    return fly(MissionSpec.model_validate(given), server).outcome


@pytest.fixture(scope="module")
def baseline(server: ForkServer) -> Outcome:
    return flown(server, pilot="baseline")


def test_the_baseline_arrives_and_repeats(baseline: Outcome, server: ForkServer) -> None:
    assert baseline.result == "success"
    assert baseline.qof.flight_time_s > 20.0
    assert flown(server, pilot="baseline").digest == baseline.digest


def test_it_takes_its_time_before_each_plan(baseline: Outcome, server: ForkServer) -> None:
    slower = flown(server, pilot="baseline", pace={**QUICK, "take_off_s": 6.0})
    assert slower.qof.flight_time_s > baseline.qof.flight_time_s + 4.0


@pytest.mark.soak
def test_a_waypoint_that_leads_astray_costs_the_baseline_what_it_does_not_cost_ours(
    baseline: Outcome, server: ForkServer
) -> None:
    struck = flown(server, pilot="baseline", fault=ASTRAY)
    assert struck.injection is not None
    assert struck.injection.status == "injected"
    assert struck.result != "success" or struck.qof.flight_time_s > 1.2 * baseline.qof.flight_time_s
    ours, with_fault = flown(server), flown(server, fault=ASTRAY)
    assert with_fault.result == "success"
    assert with_fault.qof.flight_time_s < 1.2 * ours.qof.flight_time_s


def test_what_a_guard_refuses_is_counted_and_without_it_nobody_minds(server: ForkServer) -> None:
    guarded = flown(server, fault=NO_NUMBER)
    trusting = flown(server, fault=NO_NUMBER, guards=sorted(ALL_GUARDS - {"finite"}))
    for stage in ("planning", "control"):
        assert guarded.nodes[stage].guards["finite"] == 1
        assert guarded.nodes[stage].malformed == 1
        assert trusting.nodes[stage].malformed == 0


def test_guards_that_do_not_act_leave_no_trace(server: ForkServer) -> None:
    without = sorted(ALL_GUARDS - {"finite", "range", "order", "restart"})
    assert flown(server).digest == flown(server, guards=without).digest


@pytest.mark.parametrize(("guards", "restarts"), [(None, 1), (["clip", "dense"], 0)])
def test_without_restart_a_dead_node_stays_dead(guards: list[str] | None, restarts: int) -> None:

    stack = {**STACK, "control": replace(STACK["control"], module="tests.fixtures.nodes.crashes")}
    server = ForkServer(stack)
    try:
        outcome = flown(server, guards=guards, limits={"mission_time_s": 8.0})
    finally:
        server.close()
    assert outcome.nodes["control"].crashes == 1
    assert outcome.nodes["control"].restarts == restarts
    assert outcome.nodes["control"].guards.get("restart", 0) == restarts
