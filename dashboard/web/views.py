"""What pages show of a campaign, reckoned once for all who look, and seldom enough to slow down no flight."""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from dashboard.api.campaigns import CampaignDetail, detail
from dashboard.api.hub import Hub
from dashboard.api.service import Service
from dashboard.campaigns.listing import RunPage, RunQuery, run_page
from dashboard.campaigns.side_by_side import side_by_side
from dashboard.campaigns.store import Campaign
from dashboard.campaigns.strikes import strikes
from dashboard.web.figures import figures
from dashboard.web.findings import Findings, Struck
from dashboard.web.frame import ask
from dashboard.web.progress import time_left
from dashboard.web.quality import Row, beside_rows

REST = 100
"""After what took so long, nothing is reckoned for so many times as long: at most 1 % of one processor."""

PACE_S = 2.0
"""Between two times that the figures of a campaign that flies are reckoned, and sent to whoever looks."""

LOOK_S = 2.0
"""Between two looks for what others (``zenfi campaign run``) do to a campaign; of our own doing we hear."""

MOST_CAMPAIGNS = 32
"""Whose figures are kept; and of each, pages of the table of runs."""

T = TypeVar("T")


def news(hub: Hub, label: str = "") -> int:
    """The number of the newest event that tells where a campaign (any) stands."""
    return max((event.number for event in hub.newest(label) if event.kind == "campaign"), default=0)


class Shared(Generic[T]):
    """Something that is reckoned anew when ``mark`` has changed, ``least_s`` after the last time or later."""

    def __init__(self, reckon: Callable[[], T], least_s: float = 1.0) -> None:
        self._reckon, self._least_s = reckon, least_s
        self._lock = asyncio.Lock()
        self._kept: tuple[object, T] | None = None
        self._rested_s = 0.0

    async def get(self, mark: object, *, hurry: bool = False) -> T:
        """The newest; one a little older while it is too early to reckon again, unless there is a hurry."""
        async with self._lock:
            rested = hurry or time.monotonic() >= self._rested_s
            if self._kept is None or (self._kept[0] != mark and rested):
                value, cost_s = await ask(self._timed)
                self._kept = mark, value
                self._rested_s = time.monotonic() + max(self._least_s, REST * cost_s)
            return self._kept[1]

    def _timed(self) -> tuple[T, float]:
        begin = time.thread_time()
        value = self._reckon()
        return value, time.thread_time() - begin


@dataclass(frozen=True, slots=True)
class Standing:
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


class Watched:
    """One campaign, for all of its viewers.

    :raises UnknownCampaignError: from every method, once it was deleted.
    """

    def __init__(self, here: Service, label: str) -> None:
        self._here, self._label = here, label
        self._standing = Shared(self._look)
        self._findings = Shared(lambda: Findings.of(figures(here.store, self._found())), PACE_S)
        self._struck = Shared(lambda: Struck(strikes(here.store, self._found())), PACE_S)
        self._beside = Shared(
            lambda: beside_rows(side_by_side(here.store, self._found(), None, None)), PACE_S
        )
        self._runs: OrderedDict[str, Shared[RunPage]] = OrderedDict()

    async def stands(self) -> Standing:
        """Where it stands."""
        return await self._standing.get((news(self._here.hub, self._label), time.monotonic() // LOOK_S))

    async def findings(self) -> Findings:
        """What it has found."""
        return await self._newest(self._findings)

    async def struck(self) -> Struck:
        """What its faults have struck."""
        return await self._newest(self._struck)

    async def beside(self) -> list[Row]:
        """The same beside golden twins; takes seconds where there are thousands of flights."""
        return await self._newest(self._beside)

    async def runs(self, query: RunQuery) -> RunPage:
        """Some of its runs, as they were when a run last ended."""
        asked = query.model_dump_json()
        if asked not in self._runs:
            self._runs[asked] = Shared(lambda: run_page(self._here.store, self._found(), query), PACE_S)
        self._runs.move_to_end(asked)
        if len(self._runs) > MOST_CAMPAIGNS:
            self._runs.popitem(last=False)
        return await self._newest(self._runs[asked])

    async def _newest(self, shared: Shared[T]) -> T:
        stands = await self.stands()
        return await shared.get(stands.mark, hurry=stands.still)

    def _found(self) -> Campaign:
        return self._here.store.find(self._label)

    def _look(self) -> Standing:
        found = self._found()
        told = detail(self._here, found)
        return Standing(told, time_left(self._here, found.spec, told))


class Views:
    """The campaigns that are looked at."""

    def __init__(self, here: Service) -> None:
        self._here = here
        self._kept: OrderedDict[str, Watched] = OrderedDict()

    def of(self, label: str) -> Watched:
        """The campaign of that label; whether there is one, it says itself."""
        one = self._kept.setdefault(label, Watched(self._here, label))
        self._kept.move_to_end(label)
        if len(self._kept) > MOST_CAMPAIGNS:
            self._kept.popitem(last=False)
        return one
