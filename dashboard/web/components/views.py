"""What pages show of a campaign, computed once for all who look, and seldom enough to slow down no flight."""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

from dashboard.analysis.findings import findings
from dashboard.analysis.kernel_study import WAYS
from dashboard.api.processes.event_bus import EventBus
from dashboard.api.routes.campaigns import CampaignDetail, detail
from dashboard.api.service import Service
from dashboard.campaigns.results.compare import side_by_side
from dashboard.campaigns.results.injection_groups import InjectedFlights
from dashboard.campaigns.results.summary import summary
from dashboard.campaigns.store.listing import RunListing, RunQuery, run_page
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.campaigns.store.store import Store
from dashboard.web.charts.figures import figures
from dashboard.web.components.findings import Findings, InjectionFindings
from dashboard.web.components.frame import ask
from dashboard.web.components.progress import time_left
from dashboard.web.components.quality_tables import Row, beside_rows

REST = 100
"""After what took so long, nothing is computed for so many times as long: at most 1 % of one processor."""

PACE_S = 2.0
"""Between two times that the figures of a campaign that flies are computed, and sent to whoever looks."""

LOOK_S = 2.0
"""Between two looks for what others (``zenfi campaign run``) do to a campaign; of our own doing we hear."""

MOST_CAMPAIGNS = 32
"""Whose figures are kept; and of each, pages of the table of runs."""

T = TypeVar("T")


def news(event_bus: EventBus, label: str = "") -> int:
    """The number of the newest event that tells the state of a campaign (of any)."""
    return max((event.number for event in event_bus.newest(label) if event.kind == "campaign"), default=0)


class SharedValue(Generic[T]):
    """Something that is computed anew when ``mark`` has changed, ``least_s`` after the last time or later."""

    def __init__(self, compute: Callable[[], T], least_s: float = 1.0) -> None:
        self._compute, self._least_s = compute, least_s
        self._lock = asyncio.Lock()
        self._kept: tuple[object, T] | None = None
        self._rested_s = 0.0

    async def get(self, mark: object, *, hurry: bool = False) -> T:
        """The newest; one a little older while it is too early to compute again, unless there is a hurry."""
        async with self._lock:
            rested = hurry or time.monotonic() >= self._rested_s
            if self._kept is None or (self._kept[0] != mark and rested):
                value, cost_s = await ask(self._timed)
                if self._kept is None:
                    cost_s = 0.0  # no measure of the next: code was loaded, and nothing was in a cache
                self._kept = mark, value
                self._rested_s = time.monotonic() + max(self._least_s, REST * cost_s)
            return self._kept[1]

    def _timed(self) -> tuple[T, float]:
        begin = time.thread_time()
        value = self._compute()
        return value, time.thread_time() - begin


@dataclass(frozen=True, slots=True)
class CampaignStatus:
    """Where a campaign stands, and how long it will take, in words."""

    detail: CampaignDetail
    left: str

    @property
    def mark(self) -> tuple[int, int]:
        """Changes with what was found."""
        return self.detail.done, self.detail.failed

    @property
    def still(self) -> bool:
        """Whether nobody flies it, so that nobody is slowed down and nothing more is to come."""
        return self.detail.phase != "running"


class Beside(NamedTuple):
    """The cells of a campaign beside golden twins: rows of a table, and what was found, in sentences."""

    rows: list[Row]
    found: list[str]

    @classmethod
    def of(cls, store: Store, campaign: CampaignEntry) -> Beside:
        """Compare every cell, with intervals."""
        compared = side_by_side(store, campaign, None, None)
        return cls(beside_rows(compared), findings(summary(store, campaign), compared))


class WatchedCampaign:
    """One campaign, for all of its viewers.

    :raises UnknownCampaignError: from every method, once it was deleted.
    """

    def __init__(self, service: Service, label: str) -> None:
        self._service, self._label = service, label
        self._status = SharedValue(self._look)
        self._findings = SharedValue(lambda: Findings.of(figures(service.store, self._campaign())), PACE_S)
        self._injected = InjectedFlights(WAYS)
        self._injections = SharedValue(
            lambda: InjectionFindings(self._injected.read(service.store, self._campaign())), PACE_S
        )
        self._beside = SharedValue(lambda: Beside.of(service.store, self._campaign()), PACE_S)
        self._runs: OrderedDict[str, SharedValue[RunListing]] = OrderedDict()

    async def status(self) -> CampaignStatus:
        """The phase, the progress and the time left."""
        return await self._status.get(
            (news(self._service.event_bus, self._label), time.monotonic() // LOOK_S)
        )

    async def findings(self) -> Findings:
        """The figures of the flights so far."""
        return await self._newest(self._findings)

    async def injections(self) -> InjectionFindings:
        """The injected flights so far, grouped."""
        return await self._newest(self._injections)

    async def beside(self) -> Beside:
        """The same beside golden twins; takes seconds where there are thousands of flights."""
        return await self._newest(self._beside)

    async def runs(self, query: RunQuery) -> RunListing:
        """Some of its runs, as they were when a run last ended."""
        asked = query.model_dump_json()
        if asked not in self._runs:
            self._runs[asked] = SharedValue(
                lambda: run_page(self._service.store, self._campaign(), query), PACE_S
            )
        self._runs.move_to_end(asked)
        if len(self._runs) > MOST_CAMPAIGNS:
            self._runs.popitem(last=False)
        return await self._newest(self._runs[asked])

    async def _newest(self, shared: SharedValue[T]) -> T:
        status = await self.status()
        return await shared.get(status.mark, hurry=status.still)

    def _campaign(self) -> CampaignEntry:
        return self._service.store.find(self._label)

    def _look(self) -> CampaignStatus:
        campaign = self._campaign()
        told = detail(self._service, campaign)
        return CampaignStatus(told, time_left(self._service, campaign.spec, told))


class WatchedCampaigns:
    """Keeps the shared values of the campaigns that were shown last."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._kept: OrderedDict[str, WatchedCampaign] = OrderedDict()

    def of(self, label: str) -> WatchedCampaign:
        """The campaign of that label; whether there is one, it says itself."""
        one = self._kept.setdefault(label, WatchedCampaign(self._service, label))
        self._kept.move_to_end(label)
        if len(self._kept) > MOST_CAMPAIGNS:
            self._kept.popitem(last=False)
        return one
