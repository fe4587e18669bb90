"""Further computers cost what the models say, and mask what they can."""

import pytest

from dashboard.design.second_computer import masking, second_computers
from services.models.faults.specification import FaultSpec
from sim.vehicle.airframe import airframe
from sim.vehicle.redundancy import RedundancyStudy
from tests.dashboard.design.synthetic import MOTOR, PID


def test_mass_time_and_energy_are_those_of_the_models() -> None:
    found = second_computers(RedundancyStudy(airframe="spark"))
    assert [one.mass_kg for one in found.values()] == pytest.approx([0.085, 0.17])
    # docs/world.md: 1.21 and 1.90 times the flight time
    assert [one.flight_time.mean for one in found.values()] == pytest.approx([0.21, 0.90], abs=0.006)
    # Hover power grows with the mass to the power of 3/2, beside what avionics draw.
    frame = airframe("spark")
    heavier = ((frame.mass_kg + 0.085) / frame.mass_kg) ** 1.5
    assert 1.21 < 1 + found["DMR"].energy.mean <= (1 + found["DMR"].flight_time.mean) * heavier * (1 + 1e-12)
    assert found["DMR"].energy.low is None


def test_a_vehicle_that_cannot_lift_them_has_no_such_option() -> None:
    assert list(second_computers(RedundancyStudy(airframe="spark", computer_kg=0.12))) == ["DMR"]
    assert second_computers(RedundancyStudy(airframe="spark", computer_kg=5.0)) == {}


def test_they_mask_upsets_of_one_computer_and_dmr_those_that_do_not_come_back() -> None:
    both = second_computers(RedundancyStudy())
    assert masking(PID, both) == ["DMR", "TMR"]
    stays = FaultSpec(target="pid", recurrence="permanent", opcodes=("mulsd",))
    assert masking(stays, both) == ["TMR"]
    assert masking(MOTOR, both) == []
