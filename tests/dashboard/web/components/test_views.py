"""What pages show is computed once for all who look, and not too often."""

import asyncio
import time
from collections import Counter
from contextlib import closing
from pathlib import Path

import pytest

from dashboard.analysis.kernel_study import WAYS
from dashboard.api.processes.campaign_runner import CampaignRunner
from dashboard.api.processes.event_bus import EventBus
from dashboard.api.service import Service
from dashboard.campaigns.flight_record import FlightRecord, Result
from dashboard.campaigns.results.injection_groups import InjectedFlights
from dashboard.campaigns.spec import Arm, CampaignSpec, Cell
from dashboard.campaigns.store.columns import of_records
from dashboard.campaigns.store.listing import RunQuery
from dashboard.campaigns.store.store import Store
from dashboard.web.charts import figures
from dashboard.web.components.findings import InjectionFindings
from dashboard.web.components.views import SharedValue, WatchedCampaign
from services.models.faults.specification import FaultSpec
from tests.dashboard.api.asking import waiting
from tests.dashboard.campaigns.store.test_store import outcome

CELL = Cell("arm", "sparse", "")
RESULT = Result(
    result="success",
    success=True,
    flight_time_s=20.0,
    distance_m=50.0,
    energy_kj=10.0,
    replans=0,
    min_clearance_m=1.0,
    injection="",
    node="",
    node_result="",
    twin_result="",
    twin_success=None,
    twin_flight_time_s=None,
    twin_distance_m=None,
    twin_energy_kj=None,
    twin_digest="",
    harm=None,
    harmed_at_s=None,
    alarms=None,
    recomputed=0,
    overhead=None,
    proof="",
    digest="",
    wall_s=1.0,
)


def record(number: int, success: bool = True, time_s: float = 20.0, **twin: object) -> FlightRecord:
    """A run that was flown."""
    fields = {name: getattr(RESULT, name) for name in Result.__dataclass_fields__}
    fields |= {"success": success, "result": "success" if success else "collision", "flight_time_s": time_s}
    return FlightRecord(CELL, number, number, "done", 1, "", Result(**{**fields, **twin}), number)


def test_many_who_look_at_once_have_it_reckoned_once() -> None:
    calls: list[int] = []

    def compute() -> int:
        calls.append(1)
        return len(calls)

    async def look() -> list[int]:
        shared = SharedValue(compute)
        return await asyncio.gather(*(shared.get("mark") for _ in range(10)))

    assert asyncio.run(look()) == [1] * 10


@pytest.mark.parametrize(("least_s", "seen"), [(0.0, [1, 1, 1, 2]), (1e6, [1, 1, 1, 1])])
def test_it_is_reckoned_again_when_it_has_changed_and_has_rested(least_s: float, seen: list[int]) -> None:
    calls: list[int] = []

    def compute() -> int:
        calls.append(1)
        return len(calls)

    async def look() -> list[int]:
        shared = SharedValue(compute, least_s)
        found = [await shared.get("a"), await shared.get("a")]
        await asyncio.sleep(0.2)
        return [*found, await shared.get("a"), await shared.get("b")]

    assert asyncio.run(look()) == seen


def test_what_the_first_time_took_is_no_measure() -> None:
    """It loads code: whoever looks first would see no news for minutes."""
    calls: list[int] = []

    def compute() -> int:
        calls.append(1)
        begun_s = time.thread_time()
        while time.thread_time() - begun_s < 0.1:
            pass
        return len(calls)

    async def look() -> list[int]:
        shared = SharedValue(compute, 0.0)
        return [await shared.get(mark) for mark in "abc"]

    assert asyncio.run(look()) == [1, 2, 2]


def test_what_nobody_flies_any_more_is_reckoned_at_once() -> None:
    calls: list[int] = []

    def compute() -> int:
        calls.append(1)
        return len(calls)

    async def look() -> list[int]:
        shared = SharedValue(compute, 1e6)
        seen = [await shared.get("a"), await shared.get("b"), await shared.get("b", hurry=True)]
        return [*seen, await shared.get("b", hurry=True)]

    assert asyncio.run(look()) == [1, 1, 2, 2]


def test_many_who_look_at_a_campaign_are_shown_the_same_figures_and_runs(tmp_path: Path) -> None:
    async def look(watched: WatchedCampaign) -> list[list[object]]:
        return [
            await asyncio.gather(*(watched.findings() for _ in range(10))),
            await asyncio.gather(*(watched.injections() for _ in range(10))),
            await asyncio.gather(*(watched.runs(RunQuery(limit=3)) for _ in range(10))),
        ]

    with closing(Store(tmp_path)) as store:
        found = store.create(CampaignSpec(name="seen", runs=5, arms=(Arm(name="golden"),)))
        states = store.states(found)
        store.write(found, states, [], {next(iter(states.runs)): outcome()})
        event_bus = EventBus()
        here = Service(store, event_bus, CampaignRunner(store, event_bus, 1), waiting(store, event_bus))
        for seen in asyncio.run(look(WatchedCampaign(here, found.label))):
            assert all(one is seen[0] for one in seen)


def test_strikes_are_put_into_groups_once_for_all_who_ask(tmp_path: Path) -> None:
    struck = Arm(name="a", fault=FaultSpec(target="pid"))
    with closing(Store(tmp_path)) as store:
        found = store.create(CampaignSpec(name="seen", runs=2, arms=(struck,)))
        first, second = store.planned(found)
        good = outcome()
        good = good.model_copy(update={"qof": good.qof.model_copy(update={"success": True})})
        store.write(found, store.states(found), [], {first: outcome(), second: good})
        injections = InjectionFindings(InjectedFlights(WAYS).read(store, found))
    assert injections.heat("missions failed") is not None
    groups = injections.groups("role")
    assert [(row["injected"], row["missions failed"]) for row in groups.rows] == [(2, "50 (9 to 91)")]
    assert injections.groups("role") is groups
    assert InjectionFindings().heat("missions failed") is None
    assert InjectionFindings().groups("role").rows == []


def test_boxes_are_of_the_successful_flights_and_results_of_all() -> None:
    times = (10.0, 20.0, 30.0, 40.0, 50.0)
    records = [record(n, time_s=t) for n, t in enumerate(times)] + [record(5, success=False, time_s=99.0)]
    (one,) = figures.flights([CELL], of_records([CELL], records))
    assert one.boxes is not None
    assert one.boxes[0] == times
    assert one.results == Counter(success=5, collision=1)
    assert [dot.values[0] for dot in one.dots if not dot.success] == [99.0]


def test_of_many_flights_evenly_chosen_ones_are_drawn_and_the_box_has_all() -> None:
    records = [record(n, time_s=float(n)) for n in range(10_000)]
    (one,) = figures.flights([CELL], of_records([CELL], records))
    assert one.flown == 10_000
    assert figures.MOST_DOTS / 2 <= len(one.dots) <= figures.MOST_DOTS
    assert one.boxes is not None
    assert one.boxes[0][-1] == 9999
    assert max(dot.number for dot in one.dots) > 9900


def test_a_cell_without_a_success_has_no_box() -> None:
    (one,) = figures.flights([CELL], of_records([CELL], [record(0, success=False)]))
    assert one.boxes is None
    assert figures.flights([CELL], of_records([CELL], []))[0].flown == 0
