"""Replay: an injected flight flown again, struck at the same dynamic instruction, and compared."""

from __future__ import annotations

from typing import Any, Literal, get_args

from deploy.errors import BadSpecError
from deploy.mission.flight import fly
from deploy.mission.fork_server import ForkServer
from services.models.base import Strict
from services.models.outcome import InjectionRecord, Outcome

_SAME = (
    *("status", "precision", "kernel", "invocation", "virtual_time_ns"),
    *("module", "build_id", "offset", "symbol"),
    *("instruction_bytes", "operand", "register_name", "width_bits", "bits", "address", "resampled"),
    *("model", "scope", "element_bits", "instruction_after", "held_instructions", "state", "point"),
    *("before", "after", "read_back", "strikes", "struck"),
)

ReplayAnswer = Literal["replayed", "relocated", "diverged", "not_reached"]
ANSWERS: tuple[ReplayAnswer, ...] = get_args(ReplayAnswer)
STATUS_FLAGS = ("rflags", "nzcv")
"""What a comparison leaves: of two pointers, the parity of their difference, say, tells where memory lies."""

REPEATED: frozenset[ReplayAnswer] = frozenset({"replayed", "relocated"})
"""The answers that say that the same fault had the same outcome."""


class Replay(Strict):
    """The result of a replay: whether the flight was repeated, and what differs.

    ``replayed``: same record, same outcome. ``relocated``: likewise, but memory lay elsewhere: pointers had
    other values and pointed into the same. ``diverged``: the site looked otherwise and nothing was flipped,
    or what followed differs. ``not_reached``: the call was over, or never came, before the site.
    """

    answer: ReplayAnswer
    differences: list[str] = []


def replay(first: Outcome, server: ForkServer) -> Replay:
    """Fly the mission of ``first`` again and compare both flights.

    :raises BadSpecError: if it does not say at which instruction its fault struck.
    :raises InfrastructureError: if the infrastructure failed.
    """
    record, reason = first.injection, refusal(first)
    if record is None or reason:
        raise BadSpecError(reason)
    again = fly(first.spec, server).outcome
    repeated = again.injection
    if repeated is not None and repeated.status != record.status:
        answer: ReplayAnswer = "not_reached" if repeated.status == "not_reached" else "diverged"
        return Replay(answer=answer, differences=[repeated.reason or f"the fault is {repeated.status}"])
    return compare(first, again)


def refusal(first: Outcome) -> str:
    """Why a flight cannot be replayed; empty if it can."""
    record = first.injection
    if record is None:
        return "nothing to replay: no fault was injected in this flight"
    if first.spec.clock == "realtime":
        return "nothing to replay: a flight in real time does not repeat"
    fault = first.spec.fault
    if fault is not None and fault.recurs_in_instructions:
        return "" if record.status == "injected" else f"nothing to replay: the fault is {record.status}"
    if not record.state and (record.trigger is None or record.trigger.site is None):
        how = f"precision {record.precision}"
        return f"nothing to replay: the fault is {record.status} and has no site ({how})"
    return ""


def compare(first: Outcome, again: Outcome) -> Replay:
    """Compare two flights' records and outcomes, wall times and pids aside."""
    before, after = _repeatable(first), _repeatable(again)
    differ = {name for name in before if before[name] != after[name]}
    differences = [f"{name}: {before[name]} then, {after[name]} now" for name in before if name in differ]
    answer: ReplayAnswer = "diverged" if differ else "replayed"
    if differ and differ <= _pointers(first.injection, again.injection):
        answer = "relocated"
    return Replay(answer=answer, differences=differences)


def _pointers(record: InjectionRecord | None, repeated: InjectionRecord | None) -> set[str]:
    """What may differ where memory lies elsewhere: it is a pointer, or made of one.

    That the registers at the site differ by nothing else was checked before the fault struck.
    """
    if record is None or repeated is None or record.state:
        return set()
    same_target = record.points_into and record.points_into == repeated.points_into
    moved = same_target or _same_struck_flags(record, repeated)
    return {"registers at the site", "address"} | ({"before", "after", "read_back"} if moved else set())


def _same_struck_flags(record: InjectionRecord, repeated: InjectionRecord) -> bool:
    """Whether status flags were struck that were the same.

    Those beside them may be what a comparison of pointers left.
    """
    if not record.register_name == repeated.register_name in STATUS_FLAGS:
        return False
    struck = sum(1 << bit for bit in record.bits)
    pairs = zip(
        (record.before, record.after, record.read_back),
        (repeated.before, repeated.after, repeated.read_back),
        strict=True,
    )
    return all((int(one, 16) ^ int(other, 16)) & struck == 0 for one, other in pairs)


def _repeatable(outcome: Outcome) -> dict[str, Any]:
    """The parts of an outcome that must be the same in every repetition."""
    found: dict[str, Any] = {"result": outcome.result, "digest": outcome.digest, "qof": outcome.qof}
    for stage, report in outcome.nodes.items():
        found[f"{stage}'s end"] = (report.crashes, report.hangs, report.causes)
    record = outcome.injection
    if record is not None:
        found |= {name: getattr(record, name) for name in _SAME}
        found |= _site(record)
    return found


def _site(record: InjectionRecord) -> dict[str, Any]:
    site = record.trigger.site if record.trigger is not None else None
    return (
        {}
        if site is None
        else {"instruction at the site": site.code, "registers at the site": site.registers}
    )
