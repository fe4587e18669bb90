"""The sensitivity map: which bits of which place harm the mission, in which phase of the flight.

Each flight whose fault struck once stands in one field: what it was aimed at, the part of the number that was
struck, and when. Phases are equal parts of the golden twin's flight, so that flights of any length compare.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import sqlalchemy as sa

from dashboard.campaigns.flight_record import FlightRecord, Result
from dashboard.campaigns.spec import CampaignSpec, mission_cells
from dashboard.campaigns.statistics.proportions import Interval, wilson
from dashboard.campaigns.store.queries import CampaignEntry, outcome_fields
from dashboard.campaigns.store.schema import OutcomeRow, RunRow
from dashboard.campaigns.store.store import Store
from dashboard.studies.ranking import KernelRate
from services.models.faults.arithmetic import MANTISSA_BITS
from services.models.outcome import InjectionRecord

AFTER = "after"
"""The phase after the golden twin has landed: a flight that a fault delays is struck there, too."""

SEVERAL = "several bits"


class MapField(NamedTuple):
    """Where a fault struck: pilot, kernel or state, part of the number, phase of the flight."""

    pilot: str
    place: str
    part: str
    phase: str


@dataclass(frozen=True, slots=True)
class SensitivityMap:
    """How many of the faults of each field harmed, and how many runs are in none, by the reason."""

    phases: Sequence[str]
    fields: Mapping[MapField, KernelRate]
    left_out: Mapping[str, int]

    @property
    def struck(self) -> int:
        """The number of faults in all fields."""
        return sum(one.of for one in self.fields.values())

    def parts(self, pilot: str, place: str) -> list[str]:
        """The parts of the number at a place that were struck: sign first, then from the top down."""
        return sorted({one.part for one in self.fields if one[:2] == (pilot, place)}, key=_order)

    def places(self) -> list[tuple[str, str]]:
        """Pilots and places that were struck, in the order of their names."""
        return sorted({one[:2] for one in self.fields})

    def over_phases(self, pilot: str, place: str, part: str) -> KernelRate:
        """How many of the faults in a part harmed, whenever they struck."""
        rates = [rate for one, rate in self.fields.items() if one[:3] == (pilot, place, part)]
        return KernelRate(sum(one.found for one in rates), sum(one.of for one in rates))


class MappedCampaign(NamedTuple):
    """The runs of a campaign, and by a run's id what its fault changed."""

    spec: CampaignSpec
    runs: Sequence[FlightRecord]
    injections: Mapping[int, InjectionRecord]


def phase_names(count: int) -> list[str]:
    """The names of so many equal parts of a golden flight, and of what comes after it."""
    ends = [round(100 * step / count) for step in range(count + 1)]
    return [*(f"{low}-{high} %" for low, high in pairwise(ends)), AFTER]


def gather(store: Store, campaigns: Iterable[CampaignEntry], phases: int = 3) -> SensitivityMap:
    """The map of some campaigns of a store."""
    flown = [
        MappedCampaign(one.spec, list(store.records(one)), dict(_injections(store, one))) for one in campaigns
    ]
    return sensitivity(flown, phases)


def sensitivity(campaigns: Iterable[MappedCampaign], phases: int = 3) -> SensitivityMap:
    """The map of the faults that struck once in flights without a detector; all others are counted."""
    names = phase_names(phases)
    struck: Counter[MapField] = Counter()
    harmed: Counter[MapField] = Counter()
    left_out: Counter[str] = Counter()
    for spec, runs, injections in campaigns:
        missions = dict(mission_cells(spec))
        for run in runs:
            mission, record, result = missions[run.cell], injections.get(run.id), run.result
            if mission.fault is None:
                continue
            reason = _left_out(result, record)
            if mission.detector is not None:
                left_out["with a detector"] += 1
            elif reason or result is None or record is None or not result.twin_flight_time_s:
                left_out[reason] += 1
            else:
                part_of_twin = record.virtual_time_ns / 1e9 / result.twin_flight_time_s
                phase = names[min(int(part_of_twin * phases), phases)]
                place = record.kernel or ", ".join(record.state)
                at = MapField(str(mission.pilot), place, part_struck(record), phase)
                struck[at] += 1
                harmed[at] += bool(result.harm)
    fields = {at: KernelRate(harmed[at], of) for at, of in struck.items()}
    return SensitivityMap(names, fields, dict(left_out))


def _left_out(result: Result | None, record: InjectionRecord | None) -> str:
    """Why a run stands in no field; empty if it stands in one."""
    if result is None:
        return "not flown"
    if result.injection != "injected" or record is None:
        return "not struck"
    if record.strikes:
        return "struck again and again"
    if not record.bits:
        return "not in bits"
    return "beside no golden twin" if result.harm is None or not result.twin_flight_time_s else ""


def part_struck(record: InjectionRecord) -> str:
    """The part of the number that a fault struck: sign, exponent, mantissa in halves, or eight bits."""
    parts = {_part(bit, record.element_bits) for bit in record.bits}
    return parts.pop() if len(parts) == 1 else SEVERAL


def _part(bit: int, element_bits: int) -> str:
    mantissa = MANTISSA_BITS.get(element_bits)
    if mantissa is None:
        return f"bits {bit // 8 * 8}-{bit // 8 * 8 + 7}"
    place = bit % element_bits
    if place >= mantissa:
        return "sign" if place == element_bits - 1 else "exponent"
    return "mantissa, upper" if place >= mantissa // 2 else "mantissa, lower"


def _order(part: str) -> tuple[int, int]:
    floats = ("sign", "exponent", "mantissa, upper", "mantissa, lower")
    if part in floats:
        return 0, floats.index(part)
    return (2, 0) if part == SEVERAL else (1, -int(part.removeprefix("bits ").partition("-")[0]))


def most_sensitive(found: SensitivityMap, most: int = 10) -> list[tuple[MapField, KernelRate, Interval]]:
    """The fields that harm most for certain: by the lower end of their 95 % interval (Wilson)."""
    judged = [(at, rate, wilson(*rate)) for at, rate in found.fields.items() if rate.found]
    return sorted(judged, key=lambda one: (-one[2].low, one[0]))[:most]


def _injections(store: Store, campaign: CampaignEntry) -> Iterator[tuple[int, InjectionRecord]]:
    """The injection of each run that has one, by the run's id."""
    query = (
        sa.select(RunRow.id, outcome_fields(store.database)["injection"].as_string())
        .join(OutcomeRow, OutcomeRow.run_id == RunRow.id)
        .where(RunRow.campaign_id == campaign.id)
        .order_by(RunRow.id)
    )
    with store.reading() as connection:
        for number, told in connection.execute(query):
            if told is not None:
                yield number, InjectionRecord.model_validate_json(told)
