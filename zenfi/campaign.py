"""Campaigns: many flights, stored, resumed and compared.

>>> found = Campaign("demo", scale=0.5).run()
>>> found.summary()[0].success_low, found.table().pandas(), found.plot()
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError
from rich.console import RenderableType
from rich.jupyter import JupyterMixin

from dashboard.analysis import tables
from dashboard.analysis.table import Table
from dashboard.campaigns.executors.choice import slots_of
from dashboard.campaigns.executors.spec import ExecutorSpec
from dashboard.campaigns.forecast import Forecast, forecast
from dashboard.campaigns.presets import scaled
from dashboard.campaigns.results import export
from dashboard.campaigns.results.compare import Comparison, side_by_side
from dashboard.campaigns.results.summary import CellSummary, summary
from dashboard.campaigns.scheduler import Finished
from dashboard.campaigns.session import scheduling
from dashboard.campaigns.spec import CampaignSpec, campaign_of, load_campaign
from dashboard.campaigns.store.folder import default_folder
from dashboard.campaigns.store.listing import Phase, line, stored_run
from dashboard.campaigns.store.store import Store
from dashboard.terminal.campaign_progress import CampaignProgress
from deploy.errors import BadSpecError, one_line
from services.models.outcome import Outcome
from zenfi.missions import Fault, fault_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Place = Path | str | None
"""Where campaigns are stored: a folder, ``postgresql://USER@HOST/DATABASE``, or None for the usual folder."""


class FlownCampaign(JupyterMixin, ABC):
    """What a campaign has found so far, in a store of this machine or with a service; shown as a table."""

    def __init__(self, label: str) -> None:
        self.label = label

    @property
    @abstractmethod
    def spec(self) -> CampaignSpec:
        """The specification of the campaign."""

    @property
    @abstractmethod
    def phase(self) -> Phase:
        """Whether it is being flown, done, paused, cancelled."""

    @abstractmethod
    def fly(self, *, progress: bool = True) -> None:
        """Fly what is left of it, and return when that has ended."""

    @abstractmethod
    def summary(self) -> list[CellSummary]:
        """A line per cell: success and quality of flight with 95 % intervals."""

    @abstractmethod
    def table(self) -> Table:
        """A row per run, with its result if it has one."""

    @abstractmethod
    def compare(self, *, other: str | None = None, against: str | None = None) -> list[Comparison]:
        """Each cell beside its golden twins, the arm ``against``, or the cell of its name in ``other``."""

    @abstractmethod
    def outcomes(self) -> Iterator[Outcome]:
        """The outcome of each run that was flown or proven, in the order of the runs."""

    def plot(self) -> Figure:
        """Draw success and flight time of each cell with their intervals; needs ``zenfi[plot]``.

        :raises BadSpecError: if matplotlib is not installed.
        """
        from dashboard.analysis import plots  # noqa: PLC0415 - loads the worlds

        return plots.quality(self.label, self.summary())

    def __rich__(self) -> RenderableType:
        return tables.campaign(self.label, self.summary())

    def __repr__(self) -> str:
        return f"<campaign {self.label}: {self.phase}>"


class Campaign:
    """A campaign to be flown: a preset's name, a TOML or JSON file, or the fields of a specification.

    ``arms`` and ``faults`` may be given by name: an arm's mission fields, a fault as specification, fields or
    written, None for no fault. ``scale`` is so many times the runs.

    :raises BadSpecError: if it cannot be flown, naming what is wrong.
    """

    def __init__(
        self,
        what: CampaignSpec | Path | str | None = None,
        /,
        *,
        scale: float = 1.0,
        arms: Mapping[str, Mapping[str, Any]] | Sequence[Any] | None = None,
        faults: Mapping[str, Fault | None] | Sequence[Any] | None = None,
        **fields: Any,
    ) -> None:
        given = dict(fields)
        if arms is not None:
            given["arms"] = _arms(arms)
        if faults is not None:
            given["faults"] = _faults(faults)
        if what is not None and given:
            message = f"{next(iter(given))}: a campaign is a file, a preset or fields, not both"
            raise BadSpecError(message)
        if what is None:
            made = campaign_of(given)
        elif isinstance(what, CampaignSpec):
            made = what
        else:
            made = load_campaign(str(what))
        self.spec = scaled(made, scale) if scale != 1 else made

    def forecast(self, *, slots: int | None = None, store: Place = None) -> Forecast:
        """What it takes of time and disk, and which differences it can tell."""
        at_a_time = slots_of(self.spec.executor, slots, self.spec.limits.lease_s)  # before a store is made
        with closing(Store(_at(store))) as opened:
            return forecast(self.spec, opened, at_a_time)

    def create(self, *, store: Place = None) -> StoredCampaign:
        """Store it without flying it yet."""
        where = _at(store)
        with closing(Store(where)) as opened:
            return StoredCampaign(opened.create(self.spec).label, where)

    def run(self, *, slots: int | None = None, store: Place = None, progress: bool = True) -> StoredCampaign:
        """Store it and fly it, so many flights at a time (default: one per processor).

        :raises InfrastructureError: if something of ours failed; what was flown stays, and ``fly`` goes on.
        """
        created = self.create(store=store)
        created.fly(slots=slots, progress=progress)
        return created


class StoredCampaign(FlownCampaign):
    """A campaign in a store of this machine."""

    def __init__(self, label: str, store: Place = None) -> None:
        super().__init__(label)
        self._where = _at(store)

    @property
    def spec(self) -> CampaignSpec:
        """The specification of the campaign."""
        with closing(Store(self._where)) as store:
            return store.find(self.label).spec

    @property
    def phase(self) -> Phase:
        """Whether it is being flown, done, paused, cancelled."""
        with closing(Store(self._where)) as store:
            return line(store, store.find(self.label)).phase

    def fly(
        self,
        *,
        slots: int | None = None,
        executor: ExecutorSpec | None = None,
        disk_mb: int | None = None,
        progress: bool = True,
        each: Callable[[Finished], object] = lambda _: None,
    ) -> None:
        """Fly what is left of it; ``each`` is told of every run that has ended.

        It can be interrupted (Ctrl-C) and gone on with. ``executor`` flies instead of the specification's,
        ``disk_mb`` is what the store may grow to instead of the specification's limit.

        :raises BusyError: if another process flies it.
        :raises InfrastructureError: if something of ours failed; what was flown stays.
        """
        with closing(Store(self._where)) as store:
            campaign = store.find(self.label)
            store.limit(disk_mb or campaign.spec.limits.disk_mb)
            at = executor or campaign.spec.executor
            with scheduling(store, campaign, at, slots) as scheduler:
                if store.desired_state(campaign) == "pause":  # it was obeyed
                    store.set_desired_state(campaign, "")
                states = scheduler.states
                ended = states.count("done", "cancelled")
                with CampaignProgress(self.label, len(states.runs), ended, shown=progress) as shown:
                    for one in scheduler.fly():
                        _show(one, shown)
                        shown.ended(states.count("done", "failed", "cancelled"))
                        each(one)

    def summary(self) -> list[CellSummary]:
        """A line per cell: success and quality of flight with 95 % intervals."""
        with closing(Store(self._where)) as store:
            return summary(store, store.find(self.label))

    def table(self) -> Table:
        """A row per run, with its result if it has one."""
        with closing(Store(self._where)) as store:
            return Table.of(export.COLUMNS, export.rows(store.records(store.find(self.label))))

    def compare(self, *, other: str | None = None, against: str | None = None) -> list[Comparison]:
        """Each cell beside its golden twins, the arm ``against``, or the cell of its name in ``other``."""
        with closing(Store(self._where)) as store:
            another = store.find(other) if other is not None else None
            return side_by_side(store, store.find(self.label), another, against)

    def outcomes(self) -> Iterator[Outcome]:
        """The outcome of each run that was flown or proven, in the order of the runs."""
        with closing(Store(self._where)) as store:
            campaign = store.find(self.label)
            for record in list(store.records(campaign)):
                stored = stored_run(store, campaign, record.id) if record.result is not None else None
                if stored is not None and stored.outcome is not None:
                    yield stored.outcome


def open_campaign(label: str, *, store: Place = None) -> StoredCampaign:
    """The campaign of that label, e.g. ``demo-1``.

    :raises UnknownCampaignError: if the store has none.
    """
    with closing(Store(_at(store))) as opened:
        return StoredCampaign(opened.find(label).label, store)


def campaigns(*, store: Place = None) -> list[StoredCampaign]:
    """Every campaign of a store, the oldest first."""
    with closing(Store(_at(store))) as opened:
        return [StoredCampaign(one.label, store) for one in opened.campaigns()]


def _at(store: Place) -> str:
    return str(default_folder() if store is None else store)


def _show(one: Finished, shown: CampaignProgress) -> None:
    if one.outcome is None:
        shown.failed(one.run.cell, one.run.index, one.error)
    else:
        shown.flown(success=one.outcome.qof.success, proven=one.outcome.proof is not None)


def _arms(given: Mapping[str, Mapping[str, Any]] | Sequence[Any]) -> list[Any]:
    if not isinstance(given, Mapping):
        return list(given)
    return [{"name": name, "mission": dict(mission)} for name, mission in given.items()]


def _faults(given: Mapping[str, Fault | None] | Sequence[Any]) -> list[Any]:
    if not isinstance(given, Mapping):
        return list(given)
    try:
        return [
            {"name": name, "fault": None if fault is None else fault_of(fault)}
            for name, fault in given.items()
        ]
    except ValidationError as error:
        message = f"faults: {one_line(error)}"
        raise BadSpecError(message) from error
