"""Why a flight went as it did: from the fault through the messages to the outcome, in a few sentences."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from dashboard.analysis.bits import words
from injector.tracing.symbols import demangled
from services.models.detection import AlarmRecord
from services.models.oracles.harm import HarmEvent
from services.models.outcome import InjectionRecord, Outcome

_MOST = 4
"""Topics that are named; the others are counted."""


def why(outcome: Outcome) -> str:
    """The injected flight in sentences: what was struck, what strayed, who noticed, how the mission ended.

    Empty for a flight without a fault. Times are virtual. Nothing is said of what the outcome does not tell:
    a flight that was not recorded still says when each topic left its golden twin's.
    """
    record = outcome.injection
    return "" if record is None else " ".join(_sentences(outcome, record))


def _sentences(outcome: Outcome, record: InjectionRecord) -> Iterator[str]:
    yield _strike(record)
    if record.status == "injected":
        yield _spread(outcome, record)
        yield from _deaths(outcome)
        yield from _guards(outcome)
        yield from _alarms(outcome, record)
    yield _end(outcome)
    if outcome.proof is not None:
        yield f"That is proven, not flown: {outcome.proof.told}."


def _strike(record: InjectionRecord) -> str:
    if record.status != "injected":
        reason = f": {record.reason}" if record.reason else ""
        return f"The fault did not strike ({record.status.replace('_', ' ')}{reason})."
    where, at = _where(record), f"{record.virtual_time_ns / 1e9:.3f} s"
    again = f" It was the first of {record.strikes} strikes." if record.strikes > 1 else ""
    changed = [f"{word.before} into {word.after}" for word in words(record)]
    if not changed:
        return f"At {at} {where} was changed from {record.before} to {record.after}.{again}"
    bits = f"bit {record.bits[0]}" if len(record.bits) == 1 else f"{len(record.bits)} bits"
    return f"At {at} {bits} of {where} turned {', '.join(changed)}.{again}"


def _where(record: InjectionRecord) -> str:
    if not record.kernel:
        return f"{', '.join(record.state) or record.node} in message {record.invocation}"
    what = record.register_name or (f"memory at {record.address:#x}" if record.address else "the code")
    function = f" in {demangled(record.symbol)}" if record.symbol else ""
    instruction = f" (`{record.instruction}`{function})" if record.instruction else function
    return f"{what} in call {record.invocation} of {record.kernel}{instruction}"


def _spread(outcome: Outcome, record: InjectionRecord) -> str:
    times = {name: told.diverged_at_s for name, told in outcome.topics.items()}
    strayed = sorted((at, name) for name, at in times.items() if at is not None)
    if outcome.golden is None:
        return "It has no golden twin to compare its messages with."
    if not strayed:
        return "Every message is the golden twin's."
    struck_s = record.virtual_time_ns / 1e9
    told = [f"{name} {max(at - struck_s, 0.0):.3f} s later" for at, name in strayed[:_MOST]]
    more = f" and {len(strayed) - _MOST} more" if len(strayed) > _MOST else ""
    return f"Messages left the golden twin's: {', '.join(told)}{more}."


def _deaths(outcome: Outcome) -> Iterator[str]:
    for name, report in outcome.nodes.items():
        if report.causes:
            again = f", and was started again {report.restarts} times" if report.restarts > 1 else ""
            again = ", and was started again" if report.restarts == 1 else again
            yield f"{name} died ({', '.join(report.causes)}){again}."


def _guards(outcome: Outcome) -> Iterator[str]:
    twins = outcome.golden.guards if outcome.golden is not None else ()
    acted = sorted(outcome.acting_guards - set(twins))
    if acted:
        yield f"Guards acted that did not in the golden twin: {', '.join(acted)}."


def _alarms(outcome: Outcome, record: InjectionRecord) -> Iterator[str]:
    detection, detector = outcome.detection, outcome.spec.detector
    if detection is None or detector is None:
        return
    true = [one for one in detection.alarms if one.true]
    if not true:
        yield f"The detector ({detector.scheme}) missed it."
        return
    yield f"The detector ({detector.scheme}) {_first_alarm(true, record)}."


def _first_alarm(true: Sequence[AlarmRecord], record: InjectionRecord) -> str:
    first = true[0]
    after_s = (first.virtual_time_ns - record.virtual_time_ns) / 1e9
    others = f" and {len(true) - 1} more" if len(true) > 1 else ""
    about = f"{first.stage}'s {first.state}" if first.state else f"{first.stage}, which made no sense"
    done = "published all the same" if first.action == "published" else first.action.replace("_", " ")
    return f"raised an alarm{others} {after_s:.3f} s after the strike about {about}: {done}"


def _end(outcome: Outcome) -> str:
    time_s, twin = outcome.qof.flight_time_s, outcome.golden
    ended = f"The mission ended in {outcome.result.replace('_', ' ')} after {time_s:.2f} s"
    if twin is None:
        return f"{ended}."
    twin_s = twin.qof.flight_time_s
    if outcome.qof.success and twin.qof.success:
        beside = f", {time_s - twin_s:+.2f} s beside its golden twin"
    else:
        beside = f"; its golden twin in {twin.result.replace('_', ' ')} after {twin_s:.2f} s"
    return f"{ended}{beside}{_harmed(outcome.harm)}."


def _harmed(harm: Sequence[HarmEvent] | None) -> str:
    if harm is None:
        return ""
    if not harm:
        return ": no harm"
    told = (f"{one.property or one.kind.replace('_', ' ')} from {one.at_ns / 1e9:.2f} s" for one in harm)
    return f": harm ({', '.join(told)})"
