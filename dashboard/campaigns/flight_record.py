"""One flight of a campaign in a line: what summaries, comparisons and exports read."""

from __future__ import annotations

from dataclasses import dataclass

from dashboard.campaigns.spec import Cell
from services.models.oracles.harm import first_ns, kinds
from services.models.outcome import Outcome


@dataclass(frozen=True, slots=True)
class Result:
    """What the store keeps of an outcome beside the outcome itself.

    ``node`` is the node aimed at and ``node_result`` what became of it; empty in a flight without a fault.
    ``alarms`` counts the detector's after the fault, None without a detector, and ``recomputed`` those of
    them about which something was done: an output was made again, dropped or replaced. ``overhead`` is the
    part of virtual time that its checks and what was made again took, None as well. ``harm`` names what
    harmed the flight beside its twin, and ``harmed_at_s`` says when it began; empty if nothing did, None
    where it is not known or has no twin.
    ``proof`` is by what the outcome was proven, empty if it was flown.
    """

    result: str
    success: bool
    flight_time_s: float
    distance_m: float
    energy_kj: float
    replans: int
    min_clearance_m: float
    injection: str
    node: str
    node_result: str
    twin_result: str
    twin_success: bool | None
    twin_flight_time_s: float | None
    twin_distance_m: float | None
    twin_energy_kj: float | None
    twin_digest: str
    alarms: int | None
    recomputed: int
    overhead: float | None
    harm: str | None
    harmed_at_s: float | None
    proof: str
    digest: str
    wall_s: float

    @classmethod
    def of(cls, outcome: Outcome) -> Result:
        """The columns that are stored of an outcome."""
        qof, record, twin = outcome.qof, outcome.injection, outcome.golden
        detection = outcome.detection
        aimed = outcome.nodes.get(record.node) if record is not None else None
        alarms = [one for one in detection.alarms if one.true] if detection is not None else None
        harmed_ns = first_ns(outcome.harm or ())
        return cls(
            result=outcome.result,
            success=qof.success,
            flight_time_s=qof.flight_time_s,
            distance_m=qof.distance_m,
            energy_kj=qof.energy_kj,
            replans=qof.replans,
            min_clearance_m=qof.min_clearance_m,
            injection=record.status if record is not None else "",
            node=record.node if record is not None else "",
            node_result=aimed.result if aimed is not None else "",
            twin_result=twin.result if twin is not None else "",
            twin_success=twin.qof.success if twin is not None else None,
            twin_flight_time_s=twin.qof.flight_time_s if twin is not None else None,
            twin_distance_m=twin.qof.distance_m if twin is not None else None,
            twin_energy_kj=twin.qof.energy_kj if twin is not None else None,
            twin_digest=twin.digest if twin is not None else "",
            alarms=len(alarms) if alarms is not None else None,
            recomputed=sum(one.action != "published" for one in alarms or ()),
            overhead=detection.detection_share + detection.recomputation_share
            if detection is not None
            else None,
            harm=" ".join(kinds(outcome.harm)) if outcome.harm is not None else None,
            harmed_at_s=harmed_ns / 1e9 if harmed_ns is not None else None,
            proof=outcome.proof.by if outcome.proof is not None else "",
            digest=outcome.digest,
            wall_s=outcome.wall_s,
        )


@dataclass(frozen=True, slots=True)
class FlightRecord:
    """A run with its result, if it has one."""

    cell: Cell
    number: int
    seed: int
    phase: str
    attempts: int
    error: str
    result: Result | None
    id: int
