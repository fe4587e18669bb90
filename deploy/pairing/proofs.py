"""Outcomes of faults that need not be flown: strikes on the node alone prove them.

A node acts on a flight by its messages and its death. If a struck node, which gets what it had got in the
golden twin, sends what it had sent, the flight is the twin. If its memory after the call is that after
another fault in the call, so is its flight; and if it dies within the call, the flight is that of any other
fault of which it dies there in the same way, by a signal or of the same exception. Of such a class one is
flown.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from deploy.mission.flight import FlownMission
from deploy.mission.fork_server import ForkServer
from deploy.pairing.flown_outcomes import FlownOutcomes
from deploy.pairing.strike_pass import strike
from injector.strikes.results import StrikeRecord
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec
from services.models.outcome import NodeReport, Outcome, Proof, ProofBy
from services.models.pilots import numbered


class FlightClass(NamedTuple):
    """What faults in one call have in common whose flights are one: a death in it, or the state after it.

    ``installation`` names all that decides on a node's memory besides.
    """

    installation: str
    twin: str
    kernel: str
    invocation: int
    state: str
    cause: str

    @property
    def digest(self) -> str:
        """A name for the class, the same in every process."""
        return hashlib.blake2b(json.dumps(self).encode(), digest_size=16).hexdigest()


class FlightProofs:
    """What is known of the faults of one golden twin, by strikes that were made and flights flown."""

    def __init__(self, server: ForkServer) -> None:
        self.flown = FlownOutcomes()
        self._server = server
        self._twin = ""
        self._strikes: dict[str, StrikeRecord] = {}

    @property
    def strikes(self) -> list[StrikeRecord]:
        """The strikes that were made with the last twin."""
        return list(self._strikes.values())

    def strike(self, twin: FlownMission, fault: FaultSpec, ahead: Sequence[FaultSpec]) -> StrikeRecord:
        """What a fault does to the node alone; those that follow are made with it, and remembered."""
        key = twin.outcome.spec.model_dump_json()
        if key != self._twin:
            self._twin, self._strikes = key, {}
        if fault.model_dump_json() not in self._strikes:
            wanted = [fault, *(one for one in ahead if one.target == fault.target and can_be_proven(one))]
            fresh = [one for one in dict.fromkeys(wanted) if one.model_dump_json() not in self._strikes]
            for one in strike(self._server, twin, fresh):
                self._strikes[fresh[one.index].model_dump_json()] = one
        return self._strikes[fault.model_dump_json()]

    def known(self, spec: MissionSpec, found: StrikeRecord) -> Outcome | None:
        """The outcome of a fault that was struck with, if a flight of its class was flown."""
        if found.injection is None:
            return None
        outcome = self.flown.find(self._class_of(spec, found).digest)
        if outcome is None:
            return None
        if found.state:
            return _as(spec, outcome, found, "same_state")
        struck = outcome.nodes[found.injection.node]
        died = struck.model_copy(update={"causes": [found.cause, *struck.causes[1:]]})
        nodes = outcome.nodes | {found.injection.node: died}
        return _as(spec, outcome.model_copy(update={"nodes": nodes}), found, "same_death")

    def keep(self, spec: MissionSpec, outcome: Outcome, found: StrikeRecord) -> None:
        """Remember a flight that was flown, for others of its class."""
        if found.state or found.result == "died":
            self.flown.keep(self._class_of(spec, found).digest, outcome)

    def _class_of(self, spec: MissionSpec, found: StrikeRecord) -> FlightClass:
        assert spec.fault is not None  # noqa: S101 - it was struck with
        assert found.injection is not None  # noqa: S101 - asked before
        twin = spec.model_copy(update={"fault": None}).model_dump_json()
        # Whichever signal ends a node, the flight goes on alike.
        cause = "" if found.state else "a signal" if found.cause.startswith("SIG") else found.cause
        call = spec.fault.target, found.injection.invocation
        return FlightClass(self._server.installation, twin, *call, found.state, cause)


def as_twin(spec: MissionSpec, twin: FlownMission, found: StrikeRecord) -> FlownMission | None:
    """The flight of a fault that was struck with, if it is its golden twin's."""
    if found.injection is None:
        return None
    if found.result == "same_memory" or (found.result == "same_messages" and _counted_the_same(found, twin)):
        by: ProofBy = "same_memory" if found.result == "same_memory" else "same_messages"
        return replace(twin, outcome=_as(spec, twin.outcome, found, by), messages=None)
    return None


_COUNTED = ("steps", "dropped", "malformed", "outdated", "alarms", "recomputed", "ungated", "lost")


def can_be_proven(fault: FaultSpec | None) -> bool:
    """Whether a fault strikes one instruction that is still to be drawn in a call that is known."""
    if fault is None or fault.level != "instruction" or fault.recurs or fault.trigger is None:
        return False
    trigger = fault.trigger
    return trigger.invocation is not None and (trigger.after_ns, trigger.site, trigger.cpu_ns) == (None,) * 3


def has_proofs(spec: MissionSpec) -> bool:
    """Whether a mission's nodes can run alone: in virtual time, without programs of others."""
    return spec.clock == "lockstep" and spec.stack is None


def may_stand_for_others(twin: FlownMission) -> bool:
    """Whether a golden flight can be compared with: no false alarm had a node make an output again."""
    found = twin.outcome.detection
    return found is None or not (found.alarms or found.ungated)


def _as(spec: MissionSpec, known: Outcome, found: StrikeRecord, by: ProofBy) -> Outcome:
    """The outcome of a fault whose messages are those of a flight that is known."""
    assert spec.fault is not None  # noqa: S101 - it was struck with
    assert found.injection is not None  # noqa: S101 - asked before
    fault = spec.fault.model_copy(update={"trigger": found.injection.trigger})
    update = {
        "spec": spec.model_copy(update={"fault": fault}),
        "injection": found.injection,
        "proof": Proof(by=by),
        "wall_s": 0.0,
    }
    return known.model_copy(update=update)


def _counted_the_same(found: StrikeRecord, twin: FlownMission) -> bool:
    """Whether the node counted what it had counted in the twin: refused messages, what its guards did."""
    counts = found.counts
    assert counts is not None  # noqa: S101 - told of each that sent the same
    assert found.injection is not None  # noqa: S101 - asked before
    report: NodeReport = twin.outcome.nodes[found.injection.node]
    names = numbered(twin.outcome.spec.active_guards)
    guards = {name: times for name, times in zip(names, counts["guards"], strict=False) if times}
    same = all(counts[name] == [getattr(report, name)] for name in _COUNTED)
    return same and guards == {name: times for name, times in report.guards.items() if name != "restart"}
