"""The states of a stack's processes, without I/O: events in, actions out. :mod:`.phases` says what each is.

A need is met by a process that is ready, or by one that is ready when it exits and has exited with 0.
Needs order starts and stops; a process that runs is left alone when what it needs restarts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import assert_never

from deploy.compose.events import (
    Action,
    Again,
    Ask,
    Declare,
    Ended,
    Event,
    Kill,
    Launch,
    Launched,
    NotLaunched,
    Passed,
    Seen,
    Unwant,
    Want,
)
from deploy.compose.phases import AT_REST, NEVER_S, RUNNING, Phase, ProcessState, told
from deploy.compose.stack_file import ProcessSpec


class StackStates:
    """The state of every process; :meth:`handle` is the only thing that changes it.

    ``stale`` counts what was told of lives that are over.
    """

    def __init__(self) -> None:
        self.stale = 0
        self._specs: dict[str, ProcessSpec] = {}
        self._states: dict[str, ProcessState] = {}
        self._undeclared: set[str] = set()
        # Of what is forgotten: a name that comes back must not be taken for what it was.
        self._lives: dict[str, int] = {}
        self._now_s = 0.0
        self._actions: list[Action] = []

    @property
    def processes(self) -> Mapping[str, ProcessState]:
        """Every process's state."""
        return MappingProxyType(self._states)

    @property
    def specs(self) -> Mapping[str, ProcessSpec]:
        """Every process's declaration."""
        return MappingProxyType(self._specs)

    @property
    def next_s(self) -> float:
        """When :class:`Passed` is next due."""
        return min((state.until_s for state in self._states.values()), default=NEVER_S)

    @property
    def at_rest(self) -> bool:
        """Whether nothing runs and nothing will."""
        return all(state.phase in AT_REST for state in self._states.values())

    def handle(self, event: Event, now_s: float) -> list[Action]:
        """Take in what happened at ``now_s`` (monotonic); what is to be done, in this order."""
        self._now_s = now_s
        self._actions = []
        self._handle(event)
        self._settle()
        return self._actions

    def _handle(self, event: Event) -> None:  # noqa: C901 - one case an event
        match event:
            case Declare(specs):
                self._declare(specs)
            case Want(names):
                for name in names:
                    self._want(name)
            case Unwant(names):
                for name in names:
                    self._unwant(name)
            case Again(name):
                self._again(name)
            case Passed():
                for name in self._states:
                    self._pass(name)
            case Launched() | NotLaunched() | Seen() | Ended():
                state = self._states.get(event.name)
                if state is None or state.life != event.life or state.phase not in RUNNING:
                    self.stale += 1
                else:
                    self._hear(event, state)
            case _:
                assert_never(event)

    def _hear(self, event: Launched | NotLaunched | Seen | Ended, state: ProcessState) -> None:
        name, ready = event.name, self._specs[event.name].ready
        match event:
            case Launched():
                if state.phase == "starting" and not ready.signs and not ready.exits:
                    self._become_ready(name)
            case Seen():
                if state.phase == "starting" and ready.signs:
                    self._become_ready(name)
            case NotLaunched(_, _, error):
                again = state.phase == "stopping" and not state.late
                phase: Phase = "stopped" if not state.wanted else "pending" if again else "failed"
                self._change(name, phase=phase, reason=error, wanted=phase == "pending")
            case Ended(_, _, status):
                self._end(name, status)

    # -- what somebody wants -----------------------------------------------------------------------

    def _declare(self, specs: Mapping[str, ProcessSpec]) -> None:
        for name in [name for name in self._specs if name not in specs]:
            self._undeclared.add(name)
            self._unwant(name)
        for name, spec in specs.items():
            self._undeclared.discard(name)
            changed = name in self._specs and self._specs[name] != spec
            if changed and self._states[name].phase in ("starting", "ready"):
                self._stop(name, "declared anew")
            self._specs[name] = spec
            self._states.setdefault(name, ProcessState(life=self._lives.pop(name, 0)))
            if changed and self._states[name].phase == "backing_off":
                self._change(name, phase="pending", in_a_row=0)
            if changed and self._states[name].phase == "exited":
                self._change(name, phase="stopped")
        # What has done its work and is declared as before has nothing left to do.
        for name in specs:
            if self._states[name].phase != "exited":
                self._want(name)

    def _want(self, name: str) -> None:
        """Let a process run, and what it needs; one that has come to rest gets a new chance."""
        if name in self._undeclared:
            return
        for need in self._specs[name].needs:
            if not (self._states[need].phase == "exited" and self._met(need)):
                self._want(need)
        if self._states[name].phase in AT_REST:
            self._change(name, phase="pending", in_a_row=0)
        self._change(name, wanted=True)

    def _unwant(self, name: str) -> None:
        if self._states[name].phase in ("pending", "backing_off"):
            self._change(name, phase="stopped", reason="")
        self._change(name, wanted=False)

    def _again(self, name: str) -> None:
        if self._states[name].phase in ("starting", "ready"):
            self._stop(name, "to start again")
        elif self._states[name].phase != "stopping":
            self._change(name, phase="pending", reason="")
        self._change(name, in_a_row=0)
        self._want(name)

    # -- what happens ------------------------------------------------------------------------------

    def _become_ready(self, name: str) -> None:
        settled_s = self._now_s + self._specs[name].settled_s
        self._change(name, phase="ready", until_s=settled_s, reason="")

    def _stop(self, name: str, reason: str, *, late: bool = False) -> None:
        stop = self._specs[name].stop
        until_s = self._now_s + stop.grace_s
        self._change(name, phase="stopping", until_s=until_s, reason=reason, late=late, killed=False)
        self._actions.append(Ask(name, stop.number))

    def _end(self, name: str, status: int) -> None:
        state, spec = self._states[name], self._specs[name]
        self._change(name, status=status)
        if not state.wanted:
            self._change(name, phase="stopped", reason=told(status))
        elif state.phase == "stopping" and not state.late:
            self._change(name, phase="pending")
        elif state.late or status != 0:
            why = state.reason if state.late else told(status)
            if spec.restart == "never":
                self._change(name, phase="failed", reason=why, wanted=False)
            else:
                self._back_off(name, why)
        elif spec.restart == "always":
            self._back_off(name, told(status))
        else:
            self._change(name, phase="exited", reason=told(status), wanted=False)

    def _back_off(self, name: str, why: str) -> None:
        state, spec = self._states[name], self._specs[name]
        if state.in_a_row >= spec.restarts:
            why = f"{why}; given up after {state.in_a_row} restarts in a row"
            self._change(name, phase="failed", reason=why, wanted=False)
        else:
            until_s = self._now_s + spec.backoff.pause_s(state.in_a_row)
            self._change(name, phase="backing_off", until_s=until_s, reason=why)

    def _pass(self, name: str) -> None:
        state = self._states[name]
        if state.until_s > self._now_s:
            return
        match state.phase:
            case "starting":
                within_s = self._specs[name].ready.within_s
                self._stop(name, f"not ready within {within_s:g} s", late=True)
            case "stopping":
                self._change(name, killed=True, until_s=NEVER_S)
                self._actions.append(Kill(name))
            case "backing_off":
                counts = {"restarts": state.restarts + 1, "in_a_row": state.in_a_row + 1}
                self._change(name, phase="pending", **counts)
            case _:
                self._change(name, in_a_row=0, until_s=NEVER_S)

    # -- what follows ------------------------------------------------------------------------------

    def _settle(self) -> None:
        """Start whatever may start, stop whatever may stop, forget what is not declared any more."""
        for name, state in list(self._states.items()):
            if name in self._undeclared and state.phase in AT_REST:
                self._undeclared.discard(name)
                self._lives[name] = state.life
                del self._states[name], self._specs[name]
            elif state.phase == "pending":
                self._launch_if_met(name)
            elif state.phase in ("starting", "ready") and not state.wanted and not self._holds_back(name):
                self._stop(name, "")

    def _launch_if_met(self, name: str) -> None:
        missing = [need for need in self._specs[name].needs if not self._met(need)]
        if missing:
            self._change(name, reason=f"needs {', '.join(missing)}")
            return
        spec, life = self._specs[name], self._states[name].life + 1
        until_s = self._now_s + spec.ready.within_s
        self._change(name, phase="starting", life=life, until_s=until_s, reason="", late=False, killed=False)
        self._actions.append(Launch(name, life, spec))

    def _met(self, need: str) -> bool:
        state = self._states[need]
        done = self._specs[need].ready.exits and state.phase == "exited" and state.status == 0
        return state.phase == "ready" or done

    def _holds_back(self, name: str) -> bool:
        """Whether a process that is to end as well still runs and needs this one."""
        return any(
            name in spec.needs and not self._states[other].wanted and self._states[other].phase in RUNNING
            for other, spec in self._specs.items()
        )

    def _change(self, name: str, **fields: object) -> None:
        """A new phase has no end unless one is given."""
        if "phase" in fields:
            fields = {"until_s": NEVER_S, **fields}
        self._states[name] = replace(self._states[name], **fields)  # type: ignore[arg-type]
