"""Outcomes of faults in messages, flown with other guards: a guard that does not act changes nothing.

Of a flight with guards G, say that those in A have acted, in it or in its golden twin. Then every flight of
the mission with the same fault whose guards contain A, and are among G, is that flight to the byte. Faults in
instructions are left out: a guard that is on has memory of its own, and a wrong pointer may point there.
"""

from __future__ import annotations

import hashlib
import json
from itertools import count

from deploy.mission.fork_server import ForkServer
from deploy.pairing.flown_outcomes import FlownOutcomes
from services.models.mission import MissionSpec
from services.models.outcome import Outcome, Proof
from services.models.pilots import Guards

ALWAYS: Guards = frozenset(("dense",))
"""Guards that shape every trajectory: they act wherever they are on."""


class IdleGuards:
    """What is known of flights with a fault in a message, by mission and fault, whatever the guards.

    ``flown`` keeps them. The installation of ``server`` names all that decides on a flight besides.
    """

    def __init__(self, flown: FlownOutcomes, server: ForkServer) -> None:
        self._flown, self._server = flown, server

    def known(self, spec: MissionSpec) -> Outcome | None:
        """The outcome of a specification, if a flight with other guards is the same."""
        if not self._may_share(spec):
            return None
        for number in count():
            outcome = self._flown.find(self._name(spec, number))
            if outcome is None:
                return None
            if _acted(outcome) <= spec.active_guards <= outcome.spec.active_guards:
                fault = outcome.spec.fault
                own = spec.model_copy(update={"fault": fault})
                update = {"spec": own, "proof": Proof(by="idle_guards"), "wall_s": 0.0}
                return outcome.model_copy(update=update)
        raise AssertionError

    def keep(self, spec: MissionSpec, outcome: Outcome) -> None:
        """Remember the outcome of a specification that was flown beside its golden twin."""
        if not self._may_share(spec):
            return
        number = next(one for one in count() if self._flown.find(self._name(spec, one)) is None)
        self._flown.keep(self._name(spec, number), outcome)

    def _may_share(self, spec: MissionSpec) -> bool:
        return spec.fault is not None and spec.fault.level == "source"

    def _name(self, spec: MissionSpec, number: int) -> str:
        anyhow = spec.model_copy(update={"guards": None}).model_dump_json()
        told = json.dumps([self._server.installation, "whatever the guards", anyhow, number])
        return hashlib.blake2b(told.encode(), digest_size=16).hexdigest()


def _acted(outcome: Outcome) -> Guards:
    """The guards that have changed anything, in a flight or in its golden twin."""
    assert outcome.golden is not None  # noqa: S101 - flown beside it
    acted = set(outcome.acting_guards)
    if any(report.crashes or report.hangs for report in outcome.nodes.values()):
        acted.add("restart")
    return ALWAYS & outcome.spec.active_guards | acted | set(outcome.golden.guards)
