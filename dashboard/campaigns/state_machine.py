"""The states of a campaign and of its runs, without I/O: events in, changed states out.

A run is

========== =======================================================================================
queued     waits for a worker
leased     promised to a worker, which has not begun it; the lease ends unless the worker is heard of
running    being flown; each beginning is an attempt
done       flown, with exactly one result; final
failed     *we* could not fly it, or it was disturbed or lost its worker too often; flown again if the
           campaign is resumed
cancelled  not to be flown: the campaign was cancelled, or its stopping rule needs no more
========== =======================================================================================

A campaign is

========== =======================================================================================
queued     stored, never begun
running    has a scheduler; the only state in which runs are leased
paused     left by its scheduler with a reason: interrupted, disk full; can be resumed
done       every run is done, or not needed
failed     every run has ended, and some failed, all if nothing could be set up; can be resumed
cancelled  given up; final
========== =======================================================================================

What a worker reports under a lease that it no longer holds is stale: counted and dropped. A run is
a pure function of its specification, so flying it again gives the same result.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Literal, assert_never

from dashboard.campaigns.events import (
    Alive,
    Begin,
    Cancel,
    CannotBegin,
    Disturbed,
    Event,
    Flown,
    Leased,
    LeaseTimePassed,
    Lost,
    NotFlown,
    NotNeeded,
    Pause,
    RunStarted,
)

RunPhase = Literal["queued", "leased", "running", "done", "failed", "cancelled"]
CampaignPhase = Literal["queued", "running", "paused", "done", "failed", "cancelled"]

OPEN: tuple[RunPhase, ...] = ("queued", "leased", "running")
HELD: tuple[RunPhase, ...] = ("leased", "running")


class IllegalEventError(RuntimeError):
    """An event that this state does not know: a bug of the scheduler."""


@dataclass(frozen=True, slots=True)
class RunState:
    """Where one run stands. ``lease`` is set exactly while it is leased or running."""

    phase: RunPhase = "queued"
    attempts: int = 0
    lease: str = ""
    error: str = ""


@dataclass(slots=True)
class _Lease:
    until_s: float
    runs: set[int] = field(default_factory=set)


class CampaignStates:
    """The state of a campaign with its runs; :meth:`handle` is the only thing that changes it."""

    def __init__(
        self, runs: Mapping[int, RunState], attempts: int, phase: CampaignPhase = "queued", reason: str = ""
    ) -> None:
        self.phase: CampaignPhase = phase
        self.reason = reason
        self.stale = 0
        self._attempts = attempts
        self._runs = dict(runs)
        self._counts = Counter(run.phase for run in self._runs.values())
        self._leases: dict[str, _Lease] = {}

    @property
    def runs(self) -> Mapping[int, RunState]:
        """The state of every run, by its id."""
        return MappingProxyType(self._runs)

    @property
    def leases(self) -> set[str]:
        """The leases that runs hold now."""
        return set(self._leases)

    def count(self, *phases: RunPhase) -> int:
        """How many runs are in any of ``phases``."""
        return sum(self._counts[phase] for phase in phases)

    def handle(self, event: Event) -> list[int]:
        """Take in what happened; the runs whose state has changed.

        :raises IllegalEventError: if the event is impossible in this state.
        """
        changed = self._handle(event)
        if self.phase == "running" and not self.count(*OPEN):
            self.phase = "failed" if self.count("failed") else "done"
        return changed

    def _handle(self, event: Event) -> list[int]:  # noqa: C901, PLR0911, PLR0912 - one case an event
        match event:
            case Begin():
                return self._begin()
            case Cancel():
                return self._cancel()
            case CannotBegin(reason):
                return self._give_up(event, reason)
            case Pause(reason):
                self._require(event, "running")
                self.phase, self.reason = "paused", reason
                return self._void_leases()
            case Leased():
                self._require(event, "running")
                return self._lease(event)
            case NotNeeded():
                self._require(event, "running")
                waiting = [index for index, run in self._runs.items() if run.phase == "queued"]
                return self._change(waiting, phase="cancelled", error="not needed")
            case Alive(lease, until_s):
                if self._knows(lease):
                    self._leases[lease].until_s = until_s
                return []
            case RunStarted(lease, run):
                if not self._knows(lease, run, "leased"):
                    return []
                return self._change([run], phase="running", attempts=self._runs[run].attempts + 1)
            case Flown(lease, run):
                return self._end(lease, run, "done", "")
            case NotFlown(lease, run, error):
                return self._end(lease, run, "failed", error)
            case Disturbed(lease, run, error):
                return self._disturb(lease, run, error)
            case Lost(lease, error):
                return self._lose(lease, error) if self._knows(lease) else []
            case LeaseTimePassed(now_s):
                ended = [lease for lease, held in self._leases.items() if held.until_s < now_s]
                return [run for lease in ended for run in self._lose(lease, "the worker was not heard of")]
        assert_never(event)

    def _require(self, event: Event, phase: CampaignPhase) -> None:
        if self.phase != phase:
            message = f"{type(event).__name__} while the campaign is {self.phase}"
            raise IllegalEventError(message)

    def _knows(self, lease: str, run: int | None = None, phase: RunPhase | None = None) -> bool:
        held = self._leases.get(lease)
        known = held is not None and (run is None or (run in held.runs and self._runs[run].phase == phase))
        self.stale += not known
        return known

    def _begin(self) -> list[int]:
        if self.phase in ("done", "cancelled"):
            message = f"Begin while the campaign is {self.phase}"
            raise IllegalEventError(message)
        failed = [index for index, run in self._runs.items() if run.phase == "failed"]
        self.phase, self.reason = "running", ""
        return self._void_leases() + self._change(failed, phase="queued", attempts=0, error="")

    def _cancel(self) -> list[int]:
        if self.phase in ("done", "cancelled"):
            message = f"Cancel while the campaign is {self.phase}"
            raise IllegalEventError(message)
        self.phase, self.reason = "cancelled", ""
        self._leases.clear()
        still = [index for index, run in self._runs.items() if run.phase in OPEN]
        return self._change(still, phase="cancelled", lease="", error="the campaign was cancelled")

    def _give_up(self, event: Event, reason: str) -> list[int]:
        if self.phase in ("done", "cancelled"):
            message = f"{type(event).__name__} while the campaign is {self.phase}"
            raise IllegalEventError(message)
        self.phase, self.reason = "failed", reason
        self._void_leases()
        waiting = [index for index, run in self._runs.items() if run.phase == "queued"]
        return self._change(waiting, phase="failed", error=reason)

    def _lease(self, event: Leased) -> list[int]:
        for run in event.runs:
            if self._runs[run].phase != "queued":
                message = f"run {run} is leased while it is {self._runs[run].phase}"
                raise IllegalEventError(message)
        if event.lease in self._leases:
            message = f"lease {event.lease} is given twice"
            raise IllegalEventError(message)
        self._leases[event.lease] = _Lease(event.until_s, set(event.runs))
        return self._change(event.runs, phase="leased", lease=event.lease)

    def _end(self, lease: str, run: int, phase: RunPhase, error: str) -> list[int]:
        if not self._knows(lease, run, "running"):
            return []
        held = self._leases[lease]
        held.runs.discard(run)
        if not held.runs:
            del self._leases[lease]
        return self._change([run], phase=phase, lease="", error=error)

    def _disturb(self, lease: str, run: int, error: str) -> list[int]:
        phase, why = self._after_a_loss(run, error)
        return self._end(lease, run, phase, why)

    def _lose(self, lease: str, error: str) -> list[int]:
        changed = []
        for run in sorted(self._leases.pop(lease).runs):
            phase, why = self._after_a_loss(run, error)
            changed += self._change([run], phase=phase, lease="", error=why)
        return changed

    def _after_a_loss(self, run: int, error: str) -> tuple[RunPhase, str]:
        """The phase of a run that was not flown to its end, and why: told until it has been flown."""
        state = self._runs[run]
        if state.phase == "running" and state.attempts >= self._attempts:
            return "failed", f"{error}, {state.attempts} times"
        return "queued", error if state.phase == "running" else state.error

    def _void_leases(self) -> list[int]:
        """Nobody holds anything any more; who was flying has its attempt back."""
        self._leases.clear()
        changed = []
        for index, run in self._runs.items():
            if run.phase in HELD:
                attempts = run.attempts - (run.phase == "running")
                changed += self._change([index], phase="queued", lease="", attempts=attempts)
        return changed

    def _change(self, runs: Iterable[int], **fields: object) -> list[int]:
        changed = list(runs)
        for index in changed:
            before = self._runs[index]
            after = replace(before, **fields)  # type: ignore[arg-type]
            self._runs[index] = after
            self._counts[before.phase] -= 1
            self._counts[after.phase] += 1
        return changed
