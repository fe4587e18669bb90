"""A second and a third computer: what they weigh and cost a flight, by model alone.

Flight time is by the F-1 model (:mod:`sim.vehicle.redundancy`). Power in hover is by momentum theory at the
greater mass (:mod:`sim.vehicle.energy`), energy is power by time. What the further computers draw themselves
is left out, as in that model.
"""

from __future__ import annotations

from collections.abc import Mapping

from dashboard.design.overheads import RelativeOverhead
from dashboard.design.protections import SCHEMES
from services.models.base import Strict
from services.models.faults.specification import FaultSpec
from sim.vehicle.airframe import airframe
from sim.vehicle.energy import momentum_w, power_model
from sim.vehicle.redundancy import RedundancyStudy, study

_AT_REST = (0.0, 0.0, 0.0)


class SecondComputer(Strict):
    """DMR or TMR: the mass that it adds, and its overheads; they have no interval, a model says them."""

    scheme: str
    mass_kg: float
    flight_time: RelativeOverhead
    energy: RelativeOverhead


def second_computers(asked: RedundancyStudy) -> dict[str, SecondComputer]:
    """DMR and TMR by name, without those under which the vehicle cannot lift itself.

    :raises sim.vehicle.airframe.BadAirframeError: if there is no such airframe.
    """
    frame = airframe(asked.airframe)
    bare = power_model(frame, "momentum")
    hover_w = momentum_w(bare, _AT_REST, _AT_REST)
    found = {}
    for one in study(asked):
        if one.scheme in SCHEMES and one.time_factor is not None:
            heavier_w = momentum_w(bare._replace(mass_kg=one.mass_kg), _AT_REST, _AT_REST)
            found[one.scheme] = SecondComputer(
                scheme=one.scheme,
                mass_kg=one.mass_kg - frame.mass_kg,
                flight_time=RelativeOverhead(mean=one.time_factor - 1),
                energy=RelativeOverhead(mean=one.time_factor * heavier_w / hover_w - 1),
            )
    return found


def masking(fault: FaultSpec, computers: Mapping[str, SecondComputer]) -> list[str]:
    """The schemes that are taken to mask a fault.

    None masks one of a sensor or a motor, which all computers share. TMR masks any of one computer by vote;
    DMR finds that both differ and has the output made again, which helps against what strikes once.
    """
    if fault.at_equipment:
        return []
    return [name for name in computers if name == "TMR" or fault.recurrence == "once"]
