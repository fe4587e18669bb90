"""The injected flights of a campaign are read back from the store, and grouped."""

from dashboard.campaigns.results.injection_groups import grouped, injected_flights
from dashboard.campaigns.store.listing import ArmLine, arm_lines
from dashboard.campaigns.store.store import Store
from services.models.outcome import InjectionRecord
from tests.dashboard.campaigns.store.test_store import SPEC, outcome


def test_injected_flights_have_the_record_and_how_the_flight_ended(store: Store) -> None:
    store.create(SPEC)
    found = store.create(SPEC)
    first, second, third = list(store.planned(found))[1::2]
    good = outcome()
    good = good.model_copy(update={"qof": good.qof.model_copy(update={"success": True})})
    missed = InjectionRecord(status="not_activated", node="control", kernel="pid", invocation=1)
    state = InjectionRecord(
        status="injected", node="planning", kernel="", invocation=1, state=["trajectory.vx"], bits=[62]
    )
    flown = {
        first: good,
        second: outcome().model_copy(update={"injection": missed}),
        third: outcome().model_copy(update={"injection": state}),
    }
    store.write(found, store.states(found), [], flown)
    injected = injected_flights(store, found)
    assert [(one.target, one.success, one.node_result) for one in injected] == [
        ("pid", True, "sdc"),
        ("trajectory.vx", False, ""),
    ]
    assert injected[1].record == state
    assert arm_lines(store, [found]) == {found.label: [ArmLine(arm="b", flown=3, successes=1)]}

    pid, vx = grouped(injected, lambda one: one.target)
    assert (pid.name, pid.injected, pid.failed, pid.results) == ("pid", 1, 0, {"sdc": 1})
    assert (vx.failed, vx.high) == (1, 1.0)
    assert 0.15 < vx.low < 0.25
