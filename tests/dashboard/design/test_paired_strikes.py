"""Strikes with protections: counted over the same strikes, each protection as it was alone."""

from dataclasses import replace

import numpy as np

from dashboard.campaigns.flight_record import FlightRecord
from dashboard.design.paired_strikes import BARE, PairedStrikes, paired_strikes
from dashboard.design.protections import flown_arms
from dashboard.evidence.counts import Flown
from dashboard.evidence.ledger import StrikeCounts
from tests.dashboard.design.synthetic import BUDGET, SPEC, flown

STRIKES = PairedStrikes(
    StrikeCounts(7, 6, 5),
    {
        BARE: np.array([1, 1, 1, 1, 0, 0, 1, -1], np.int8),
        "a": np.array([1, 0, 1, 0, 1, 0, -1, 1], np.int8),
        "b": np.array([1, 1, 0, 0, 0, 0, 1, 1], np.int8),
    },
)


def test_without_a_protection_they_are_those_of_the_ledger() -> None:
    assert STRIKES.counts(()) == (7, 6, 5)


def test_what_either_averts_is_averted_and_what_either_adds_is_added() -> None:
    assert STRIKES.counts(("a",)) == (6, 6, 3)
    assert STRIKES.counts(("b",)) == (7, 7, 3)
    # Of the strikes known in all: the first harms in both, the fifth is harm that "a" adds.
    assert STRIKES.counts(("a", "b")) == (6, 6, 2)


def test_pairs_and_strikes_without_a_partner() -> None:
    assert STRIKES.pairs("a") == (2, 1, 2, 1)
    assert (STRIKES.unpaired("a"), STRIKES.unpaired("b")) == (1, 0)


def test_strikes_are_paired_by_world_number_and_seed() -> None:
    campaign, runs = flown(SPEC)
    arms = flown_arms(BUDGET, [(campaign, runs)])
    (pid, _) = arms.elements

    def strikes(records: list[FlightRecord]) -> PairedStrikes:
        told: Flown = (campaign, records)
        return paired_strikes(pid, arms.protections, [told])

    found = strikes(list(runs))
    mixed = sorted(runs, key=lambda one: (-one.number, one.cell))
    assert strikes(mixed).counts(("finite", "gaussian")) == found.counts(("finite", "gaussian"))
    assert found.counts(()).harmed > found.counts(("finite",)).harmed
    assert found.unpaired("gaussian") == 0
    elsewhere = [replace(one, seed=one.seed + 1) if one.cell.arm == "finite" else one for one in runs]
    assert strikes(elsewhere).counts(("finite",)).struck == 0
    failed = [replace(one, result=None) if one.cell.arm == "gaussian" else one for one in runs]
    assert strikes(failed).unpaired("gaussian") == found.counts(()).struck
