"""Flies runs that no store keeps: for benches and tests of executors."""

from collections.abc import Iterable, Iterator
from contextlib import closing

from dashboard.campaigns.executors.local import LocalExecutor
from dashboard.campaigns.scheduler import Finished, Scheduler
from dashboard.campaigns.spec import CampaignLimits, Run
from dashboard.campaigns.state_machine import CampaignStates, RunState
from dashboard.campaigns.stopping import StoppingRule


def fly_all(runs: Iterable[Run], slots: int | None = None) -> Iterator[Finished]:
    """Fly runs that no store keeps, yielding each as it ends. Leaving early ends everything started."""
    planned = dict(enumerate(runs))
    limits = CampaignLimits()
    states = CampaignStates({index: RunState() for index in planned}, limits.attempts)
    last = max((run.index for run in planned.values()), default=0)
    rule = StoppingRule(None, planned.values(), last + 1)
    with closing(LocalExecutor(slots, limits.lease_s)) as executor:
        yield from Scheduler(states, planned, executor, rule, limits.lease_s, lambda *_: None).fly()
