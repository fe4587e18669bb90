"""The state machine under orders of events that nobody thought of."""

import copy
import itertools
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dashboard.campaigns.events import (
    Alive,
    Begin,
    Cancel,
    CannotBegin,
    Disturbed,
    Event,
    Flown,
    Leased,
    LeaseTimePassed,
    Lost,
    NotFlown,
    NotNeeded,
    Pause,
    RunStarted,
)
from dashboard.campaigns.state_machine import HELD, OPEN, CampaignStates, IllegalEventError, RunState

RUNS, ATTEMPTS = 4, 2
DOCUMENTATION = Path(__file__).parents[3] / "docs" / "internals" / "campaigns.md"
leases = st.sampled_from(["a", "b", "c"])
runs = st.integers(0, RUNS - 1)
times = st.floats(0, 10)
events = st.one_of(
    st.builds(Begin),
    st.builds(Leased, leases, st.lists(runs, min_size=1, unique=True).map(tuple), times),
    st.builds(RunStarted, leases, runs),
    st.builds(Alive, leases, times),
    st.builds(Flown, leases, runs),
    st.builds(NotFlown, leases, runs, st.just("broken")),
    st.builds(Disturbed, leases, runs, st.just("killed")),
    st.builds(Lost, leases, st.just("lost")),
    st.builds(LeaseTimePassed, times),
    st.builds(NotNeeded),
    st.builds(Pause, st.just("interrupted")),
    st.builds(Cancel),
    st.builds(CannotBegin, st.just("why")),
)


def fresh(count: int = RUNS) -> CampaignStates:
    return CampaignStates({index: RunState() for index in range(count)}, ATTEMPTS)


def fly_the_rest(campaign: CampaignStates) -> None:
    """A scheduler that comes afterwards, whose workers do not die."""
    if campaign.phase in ("done", "cancelled"):
        return
    campaign.handle(Begin())
    for index, run in list(campaign.runs.items()):
        if run.phase == "queued":
            for event in (Leased(f"rest {index}", (index,), 1.0), RunStarted(f"rest {index}", index)):
                campaign.handle(event)
            campaign.handle(Flown(f"rest {index}", index))


@given(st.lists(events, max_size=40))
@settings(max_examples=400)
def test_any_order_of_events_keeps_the_promises(story: list[Event]) -> None:
    campaign = fresh()
    results: Counter[int] = Counter()
    for event in story:
        before = dict(campaign.runs)
        try:
            changed = campaign.handle(event)
        except IllegalEventError:
            assert dict(campaign.runs) == before
            continue
        assert {index for index in before if before[index] != campaign.runs[index]} == set(changed)
        if isinstance(event, Flown):
            results.update(changed)
        for index, run in campaign.runs.items():
            assert (run.lease != "") == (run.phase in HELD)
            assert run.attempts <= ATTEMPTS
            if before[index].phase == "done":
                assert run == before[index]
            if run.phase in HELD:
                assert campaign.phase == "running"
        still = any(run.phase in OPEN for run in campaign.runs.values())
        assert still or campaign.phase not in ("running", "paused") or isinstance(event, Pause)
        assert campaign.phase not in ("done", "failed", "cancelled") or not still
    done = {index for index, run in campaign.runs.items() if run.phase == "done"}
    assert results == Counter(done)
    fly_the_rest(campaign)
    assert campaign.phase in ("done", "cancelled")
    assert done <= {index for index, run in campaign.runs.items() if run.phase == "done"}


def everything_that_can_happen(runs: int, names: str) -> Iterator[Event]:
    yield from (Begin(), NotNeeded(), Pause("why"), Cancel(), CannotBegin("why"), LeaseTimePassed(1.0))
    for lease in names:
        yield from (Lost(lease, "lost"), Alive(lease, 2.0))
        for size in range(1, runs + 1):
            yield from (Leased(lease, some, 0.0) for some in itertools.combinations(range(runs), size))
        for run in range(runs):
            yield from (RunStarted(lease, run), Flown(lease, run), NotFlown(lease, run, "broken"))
            yield Disturbed(lease, run, "killed")


def identity(campaign: CampaignStates) -> tuple[object, ...]:
    held = sorted((name, lease.until_s, tuple(lease.runs)) for name, lease in campaign._leases.items())
    return (campaign.phase, tuple(campaign.runs.values()), tuple(held))


Change = tuple[str, str, str]


def reachable_changes() -> tuple[set[Change], set[Change]]:
    """Every change of a run's and of a campaign's state that two runs and two workers can bring about."""
    waiting, seen = [fresh(2)], {identity(fresh(2))}
    of_runs: set[Change] = set()
    of_campaigns: set[Change] = set()
    while waiting:
        before = waiting.pop()
        for event in everything_that_can_happen(2, "ab"):
            after = copy.deepcopy(before)
            try:
                after.handle(event)
            except IllegalEventError:
                continue
            name = type(event).__name__
            moved = zip(phases(before), phases(after), strict=True)
            of_runs |= {(old, name, new) for old, new in moved if old != new}
            if before.phase != after.phase:
                of_campaigns.add((before.phase, name, after.phase))
            if identity(after) not in seen:
                seen.add(identity(after))
                waiting.append(after)
    return of_runs, of_campaigns


def documented_changes(title: str) -> set[Change]:
    """The table under a heading of the documentation: from, events, to."""
    section = DOCUMENTATION.read_text().partition(f"### {title}\n")[2].partition("\n#")[0]
    rows = re.findall(r"^\| (\w+) \| ([\w, ]+) \| (\w+) \|", section, flags=re.MULTILINE)
    return {(old, event, new) for old, events_, new in rows for event in events_.split(", ")} - {
        ("from", "event", "to")
    }


def test_the_documentation_has_every_change_that_can_happen_and_no_other() -> None:
    of_runs, of_campaigns = reachable_changes()
    assert documented_changes("A run") == of_runs
    assert documented_changes("A campaign") == of_campaigns


def told(*story: Event, count: int = 2) -> CampaignStates:
    campaign = fresh(count)
    for event in (Begin(), *story):
        campaign.handle(event)
    return campaign


def phases(campaign: CampaignStates) -> list[str]:
    return [run.phase for run in campaign.runs.values()]


def test_a_flight_from_the_queue_to_its_result() -> None:
    campaign = told(Leased("a", (0, 1), 5.0), RunStarted("a", 0), Flown("a", 0))
    assert phases(campaign) == ["done", "leased"]
    campaign.handle(RunStarted("a", 1))
    campaign.handle(Flown("a", 1))
    assert campaign.phase == "done"


def test_a_lost_worker_costs_an_attempt_only_of_what_it_flew() -> None:
    campaign = told(Leased("a", (0, 1), 5.0), RunStarted("a", 0), Lost("a", "killed"))
    assert [(run.phase, run.attempts) for run in campaign.runs.values()] == [("queued", 1), ("queued", 0)]


def test_a_disturbed_flight_costs_an_attempt_and_its_worker_goes_on() -> None:
    campaign = told(Leased("a", (0, 1), 5.0), RunStarted("a", 0), Disturbed("a", 0, "killed"))
    assert [(run.phase, run.attempts) for run in campaign.runs.values()] == [("queued", 1), ("leased", 0)]
    campaign.handle(RunStarted("a", 1))
    campaign.handle(Flown("a", 1))
    assert phases(campaign) == ["queued", "done"]


@pytest.mark.parametrize("end", [Lost("", "killed"), Disturbed("", 0, "killed")])
def test_retries_are_bounded(end: Lost | Disturbed) -> None:
    campaign = fresh(1)
    campaign.handle(Begin())
    for name in ("a", "b"):
        for event in (Leased(name, (0,), 5.0), RunStarted(name, 0), replace(end, lease=name)):
            campaign.handle(event)
    assert campaign.phase == "failed"
    assert campaign.runs[0].error == "killed, 2 times"


def test_our_own_failure_is_not_tried_again() -> None:
    campaign = told(Leased("a", (0,), 5.0), RunStarted("a", 0), NotFlown("a", 0, "a bug"), count=1)
    assert phases(campaign) == ["failed"]
    assert campaign.runs[0].attempts == 1


def test_a_silent_worker_loses_its_lease_and_its_late_result_is_stale() -> None:
    campaign = told(
        Leased("a", (0,), 5.0), RunStarted("a", 0), Alive("a", 9.0), LeaseTimePassed(8.0), count=1
    )
    assert phases(campaign) == ["running"]
    campaign.handle(LeaseTimePassed(9.5))
    assert phases(campaign) == ["queued"]
    assert campaign.handle(Flown("a", 0)) == []
    assert phases(campaign) == ["queued"]
    assert campaign.stale == 1


def test_a_pause_gives_the_attempt_back() -> None:
    campaign = told(Leased("a", (0, 1), 5.0), RunStarted("a", 0), Pause("disk full"))
    assert (campaign.phase, campaign.reason) == ("paused", "disk full")
    assert all(run == RunState() for run in campaign.runs.values())


def test_what_a_dead_scheduler_had_leased_is_queued_again() -> None:
    left = {0: RunState("running", 1, "old"), 1: RunState("leased", 0, "old"), 2: RunState("done", 1)}
    campaign = CampaignStates(left, ATTEMPTS, "running")
    assert sorted(campaign.handle(Begin())) == [0, 1]
    assert phases(campaign) == ["queued", "queued", "done"]
    assert campaign.runs[0].attempts == 0


def test_a_stopping_rule_ends_it_early() -> None:
    campaign = told(Leased("a", (0,), 5.0), RunStarted("a", 0), Flown("a", 0), NotNeeded())
    assert phases(campaign) == ["done", "cancelled"]
    assert campaign.phase == "done"


@pytest.mark.parametrize("event", [Leased("a", (0,), 1.0), Pause("why"), NotNeeded()])
def test_nothing_is_leased_before_the_beginning(event: Any) -> None:
    with pytest.raises(IllegalEventError, match="queued"):
        fresh().handle(event)


def test_a_run_is_not_leased_twice() -> None:
    campaign = told(Leased("a", (0,), 5.0))
    with pytest.raises(IllegalEventError, match="run 0"):
        campaign.handle(Leased("b", (0, 1), 5.0))
    assert phases(campaign) == ["leased", "queued"]
