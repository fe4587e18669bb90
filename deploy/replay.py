"""Replay: an injected flight flown again, struck at the same dynamic instruction, and compared."""

from __future__ import annotations

from typing import Any, Literal

from deploy.check import BadSpecError
from deploy.forkserver import ForkServer
from deploy.mission import fly
from services.bus.model import Strict
from services.bus.outcome import InjectionRecord, Outcome

_SAME = (
    *("status", "mode", "kernel", "invocation", "virtual_time_ns", "module", "build_id", "offset", "symbol"),
    *("instruction_bytes", "operand", "register_name", "width_bits", "bits", "address", "resampled"),
    *("model", "scope", "element_bits", "instruction_after", "held_instructions", "state", "point"),
    *("before", "after", "read_back"),
)


class Replay(Strict):
    """What became of a replay.

    ``replayed``: same record, same outcome. ``diverged``: the site looked otherwise and nothing was
    flipped, or what followed differs. ``not_reached``: the call was over, or never came, before the site.
    """

    answer: Literal["replayed", "diverged", "not_reached"]
    differences: list[str] = []


def replay(first: Outcome, server: ForkServer) -> Replay:
    """Fly ``first`` again and compare.

    :raises BadSpecError: if it does not say at which instruction its fault struck.
    :raises InfrastructureError: if we failed.
    """
    record, reason = first.injection, refusal(first)
    if record is None or reason:
        raise BadSpecError(reason)
    again = fly(first.spec, server).outcome
    repeated = again.injection
    if repeated is not None and repeated.status != record.status:
        answer: Literal["diverged", "not_reached"] = (
            "not_reached" if repeated.status == "not_reached" else "diverged"
        )
        return Replay(answer=answer, differences=[repeated.reason or f"the fault is {repeated.status}"])
    return compare(first, again)


def refusal(first: Outcome) -> str:
    """Why a flight cannot be replayed; empty if it can."""
    record = first.injection
    if record is None:
        return "nothing to replay: no fault was injected in this flight"
    if first.spec.clock == "realtime":
        return "nothing to replay: a flight in real time does not repeat"
    if not record.state and (record.trigger is None or record.trigger.site is None):
        return f"nothing to replay: the fault is {record.status} and tells no site (mode {record.mode})"
    return ""


def compare(first: Outcome, again: Outcome) -> Replay:
    """Compare two flights' records and outcomes, wall times and pids aside."""
    before, after = _told(first), _told(again)
    differences = [
        f"{name}: {before[name]} then, {after[name]} now" for name in before if before[name] != after[name]
    ]
    return Replay(answer="diverged" if differences else "replayed", differences=differences)


def _told(outcome: Outcome) -> dict[str, Any]:
    """What has to be the same in every repetition."""
    told: dict[str, Any] = {"result": outcome.result, "digest": outcome.digest, "qof": outcome.qof}
    for stage, report in outcome.nodes.items():
        told[f"{stage}'s end"] = (report.crashes, report.hangs, report.causes)
    record = outcome.injection
    if record is not None:
        told |= {name: getattr(record, name) for name in _SAME}
        told |= _site(record)
    return told


def _site(record: InjectionRecord) -> dict[str, Any]:
    site = record.trigger.site if record.trigger is not None else None
    return (
        {}
        if site is None
        else {"instruction at the site": site.code, "registers at the site": site.registers}
    )
