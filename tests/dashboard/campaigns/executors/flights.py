"""One small campaign of real flights, flown by any executor."""

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing

from dashboard.campaigns.executors.executor import Executor
from dashboard.campaigns.executors.local import LocalExecutor
from dashboard.campaigns.scheduler import Finished, Scheduler, Write
from dashboard.campaigns.spec import Arm, CampaignSpec, Cell, Run, runs
from dashboard.campaigns.state_machine import CampaignStates, RunState
from dashboard.campaigns.stopping import StoppingRule
from services.models.faults.specification import FaultSpec
from services.models.mission import Limits, MissionSpec
from services.models.outcome import Outcome
from tests.conftest import descendants

LEASE_S = 60.0
SHORT = MissionSpec(limits=Limits(mission_time_s=1.5))
PLANNED = dict(
    enumerate(
        runs(
            CampaignSpec(
                name="x",
                runs=2,
                mission=SHORT,
                arms=(
                    Arm(name="golden"),
                    Arm(name="rrt", mission={"planner": "rrt"}),
                    Arm(name="flip", fault=FaultSpec(level="source", target="trajectory.vx")),
                ),
            )
        )
    )
)
Told = tuple[object, ...]
Outcomes = dict[tuple[Cell, int], Told]


def unkept(_: CampaignStates, __: Sequence[int], ___: Mapping[int, Outcome]) -> None:
    """Nothing is stored."""


def scheduler_of(
    executor: Executor, planned: Mapping[int, Run] = PLANNED, write: Write = unkept
) -> Scheduler:
    states = CampaignStates({run: RunState() for run in planned}, 5)
    rule = StoppingRule(None, planned.values(), 100)
    return Scheduler(states, planned, executor, rule, LEASE_S, write)


def told(finished: Finished) -> Told:
    """What must not depend on who flew a run."""
    outcome = finished.outcome
    assert outcome is not None, finished.error
    return (outcome.result, outcome.digest, outcome.qof, outcome.topics, outcome.golden)


def flown(executor: Executor, write: Write = unkept) -> tuple[Outcomes, list[int]]:
    """Every run's outcome, and how often each was begun. Fails if a run ends twice or not at all.

    Prints why runs were flown again.
    """

    def tell(states: CampaignStates, changed: Sequence[int], outcomes: Mapping[int, Outcome]) -> None:
        for run in changed:
            if states.runs[run].phase == "queued" and states.runs[run].error:
                print(f"run {run}: {states.runs[run].error}")  # noqa: T201 - where a test fails
        write(states, changed, outcomes)

    with closing(executor):
        scheduler = scheduler_of(executor, write=tell)
        ended = list(scheduler.fly())
    outcomes = {(one.run.cell, one.run.index): told(one) for one in ended}
    assert len(outcomes) == len(ended) == len(PLANNED)
    assert scheduler.states.phase == "done"
    return outcomes, [run.attempts for run in scheduler.states.runs.values()]


def flown_here() -> Outcomes:
    """The same by the local executor."""
    return flown(LocalExecutor(1, LEASE_S))[0]


def at_the_nth_beginning(count: int, act: Callable[[CampaignStates, int], None]) -> Write:
    """A store that does something when a run has just been begun, for the ``count``-th time."""
    begun = 0

    def write(states: CampaignStates, changed: Sequence[int], _: Mapping[int, Outcome]) -> None:
        nonlocal begun
        for run in changed:
            if states.runs[run].phase == "running":
                begun += 1
                if begun == count:
                    act(states, run)

    return write


def nodes(owner: int | None = None) -> list[int]:
    """Nodes of flights that a process (default: this one) or what it started is responsible for."""
    family = descendants(owner if owner is not None else os.getpid())
    return [pid for pid, name in family.items() if name.startswith("zenfi-")]
