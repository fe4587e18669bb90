"""The injected flights of a campaign are read back from the store, and grouped."""

from dashboard.campaigns.results.injection_groups import BETWEEN, TARGET, InjectedFlights
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
    assert arm_lines(store, [found]) == {found.label: [ArmLine(arm="b", flown=3, successes=1)]}

    table = InjectedFlights({"bits": lambda record: str(record.bits)}).read(store, found)
    assert len(table) == 2
    pid, vx = table.grouped(TARGET)
    assert (pid.name, pid.injected, pid.failed, pid.results) == ("pid", 1, 0, {"sdc": 1})
    assert (vx.name, vx.failed, vx.results, vx.high) == ("trajectory.vx", 1, {"": 1}, 1.0)
    assert 0.15 < vx.low < 0.25
    assert [one.name for one in table.grouped(TARGET, of_kernels=True)] == ["pid"]
    assert BETWEEN.join(("[62]", "trajectory.vx")) in [one.name for one in table.grouped("bits", TARGET)]


def test_only_what_has_changed_is_read_again(store: Store) -> None:
    found, other = store.create(SPEC), store.create(SPEC)
    planned = list(store.planned(found))[1::2]
    read: list[InjectionRecord] = []

    def noted(record: InjectionRecord) -> str:
        read.append(record)
        return "read"

    flights, counts = InjectedFlights({"all": noted}), []
    for run in planned[:3]:
        store.write(found, store.states(found), [], {run: outcome()})
        counts.append((len(flights.read(store, found)), len(read)))
    assert counts == [(1, 1), (2, 2), (3, 3)]
    (group,) = flights.read(store, found).grouped("all")
    assert (group.injected, len(read)) == (3, 3)
    assert len(flights.read(store, other)) == 0
