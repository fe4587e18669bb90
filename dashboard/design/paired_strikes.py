"""What the same strikes did to missions with each protection, and with several of them together.

In a combination each protection keeps the effect that it had alone on the same strike: a strike that harmed
the bare mission harms if none of them averted the harm, one that did not harms if any of them added some.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dashboard.campaigns.flight_record import FlightRecord
from dashboard.campaigns.statistics.proportions import Pairs
from dashboard.design.protections import ProtectedElement, Protection
from dashboard.evidence.counts import Flown, runs_of, strikes_of
from dashboard.evidence.ledger import StrikeCounts

BARE = ""
"""The key of the bare arm's strikes."""

_UNKNOWN = -1


@dataclass(frozen=True, slots=True)
class PairedStrikes:
    """The strikes of an element; ``harm`` has of each arm whether each one harmed: 1, 0, or -1 if not known.

    It is not known where the fault did not strike, the flight failed or harm was not judged. ``alone`` are
    the counts of the bare arm by itself.
    """

    alone: StrikeCounts
    harm: Mapping[str, NDArray[np.int8]]

    def counts(self, chosen: Collection[str]) -> StrikeCounts:
        """Strikes with these protections on: those that struck bare and with each of them alone.

        Without any they are all of the bare arm, as in the ledger of ``zenfi evidence``.
        """
        if not chosen:
            return self.alone
        bare, beside = self.harm[BARE], np.array([self.harm[name] for name in chosen])
        known = (bare != _UNKNOWN) & (beside != _UNKNOWN).all(axis=0)
        harmed = np.where(bare == 1, (beside == 1).all(axis=0), (beside == 1).any(axis=0))
        struck = int(np.count_nonzero(known))
        return StrikeCounts(struck, struck, int(np.count_nonzero(known & harmed)))

    def pairs(self, name: str) -> Pairs:
        """How many strikes harmed with a protection and bare, with it only, bare only, and neither."""
        bare, own = self.harm[BARE], self.harm[name]
        known = (bare != _UNKNOWN) & (own != _UNKNOWN)
        return Pairs.of(own[known] == 1, bare[known] == 1)

    def unpaired(self, name: str) -> int:
        """How many strikes of the bare arm have none beside them with this protection."""
        return int(np.count_nonzero((self.harm[BARE] != _UNKNOWN) & (self.harm[name] == _UNKNOWN)))


def paired_strikes(
    element: ProtectedElement, protections: Sequence[Protection], campaigns: Sequence[Flown]
) -> PairedStrikes:
    """An element's strikes, bare and with each of the protections: runs of one world, number and seed."""
    bare = element.element
    places = {_place(run): row for row, (_, run) in enumerate(runs_of(bare, campaigns))}
    harm = {BARE: _harm(places, [run for _, run in runs_of(bare, campaigns)])}
    for one in protections:
        cell = one.cells[bare.name]
        named = bare.model_copy(update=cell._asdict())
        harm[one.name] = _harm(places, [run for _, run in runs_of(named, campaigns)])
    return PairedStrikes(strikes_of(bare, campaigns).counts, harm)


def _place(run: FlightRecord) -> tuple[str, int, int]:
    return run.cell.world, run.number, run.seed


def _harm(places: Mapping[tuple[str, int, int], int], runs: Sequence[FlightRecord]) -> NDArray[np.int8]:
    found = np.full(len(places), _UNKNOWN, np.int8)
    for run in runs:
        row = places.get(_place(run))
        if row is not None and run.result is not None and run.result.injection == "injected":
            found[row] = _UNKNOWN if run.result.harm is None else bool(run.result.harm)
    return found
