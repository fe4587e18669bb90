"""The states of a stack's processes, without I/O: events in, actions out.

A need is met by a process that is ready, or by one that is ready when it exits and has exited with 0.
Needs order starts and stops; a process that runs is left alone when what it needs restarts, unless it is
declared to restart with that: then it ends first, and starts again when what it needs is ready.

A process is

=========== ======================================================================================
pending     wanted; waits until what it needs is ready
starting    runs, and has not shown yet that it is ready; too long and it is stopped as a failure
ready       runs and is ready; has been so long enough and its restarts are counted anew; does not
            answer its probes and it is stopped as a failure
backing_off ended though it should run; starts again when the pause is over
stopping    was asked to end: to stay stopped, to start again, or as it failed; is killed when its
            grace is over
stopped     not wanted, and not running
exited      ended by itself, and its policy lets it: status 0, or a policy of ``never``
failed      could not be started, or ended once more than its policy tries again
=========== ======================================================================================
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal, assert_never

from deploy.compose.events import (
    Action,
    Ask,
    Declare,
    Ended,
    Event,
    Kill,
    Launch,
    Launched,
    NotAlive,
    NotLaunched,
    Probe,
    Restart,
    SignsSeen,
    TimePassed,
    Unwant,
    Want,
)
from deploy.compose.stack_file import ProcessSpec
from services.system.signal_names import signal_name

Phase = Literal["pending", "starting", "ready", "backing_off", "stopping", "stopped", "exited", "failed"]

RUNNING: tuple[Phase, ...] = ("starting", "ready", "stopping")
AT_REST: tuple[Phase, ...] = ("stopped", "exited", "failed")
BEFORE_A_START: tuple[Phase, ...] = ("pending", "backing_off")
MOVING: tuple[Phase, ...] = ("starting", "backing_off", "stopping")
"""Those that end by themselves."""
NEVER_S = float("inf")


@dataclass(frozen=True, slots=True)
class ProcessState:
    """The state of one process. ``until_s`` is when its phase ends if nothing happens before.

    ``restarts`` counts those by policy, ``in_a_row`` those since it last settled; ``failing`` says that it
    is stopping because it was not ready in time or is not alive, ``killed`` that its grace is over. ``due``
    is why it has to start again, as soon as those that restart with it have ended.
    """

    phase: Phase = "stopped"
    wanted: bool = False
    life: int = 0
    until_s: float = NEVER_S
    restarts: int = 0
    in_a_row: int = 0
    failing: bool = False
    due: str = ""
    killed: bool = False
    reason: str = ""
    status: int | None = None


def status_text(status: int) -> str:
    """An exit status in words: a code, or the name of a signal."""
    if status >= 0:
        return f"exit status {status}"
    return signal_name(-status)


class StackStates:
    """The state of every process; :meth:`handle` is the only thing that changes it.

    ``stale`` counts events of starts that are over.
    """

    def __init__(self) -> None:
        self.stale = 0
        self._specs: dict[str, ProcessSpec] = {}
        self._states: dict[str, ProcessState] = {}
        self._undeclared: set[str] = set()
        # Of what is forgotten: a name that comes back must not be taken for what it was.
        self._forgotten_lives: dict[str, int] = {}
        self._now_s = 0.0
        self._actions: list[Action] = []

    @property
    def processes(self) -> Mapping[str, ProcessState]:
        """The state of every process, by name."""
        return MappingProxyType(self._states)

    @property
    def specs(self) -> Mapping[str, ProcessSpec]:
        """Every process's declaration."""
        return MappingProxyType(self._specs)

    @property
    def next_s(self) -> float:
        """When :class:`TimePassed` is next due."""
        return min((state.until_s for state in self._states.values()), default=NEVER_S)

    @property
    def at_rest(self) -> bool:
        """Whether nothing runs and nothing will."""
        return all(state.phase in AT_REST for state in self._states.values())

    def handle(self, event: Event, now_s: float) -> list[Action]:
        """Take in an event at ``now_s`` (monotonic); the actions that follow, in order."""
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
            case Restart(name):
                self._again(name)
            case TimePassed():
                for name in self._states:
                    self._pass(name)
            case Launched() | NotLaunched() | SignsSeen() | NotAlive() | Ended():
                state = self._states.get(event.name)
                if state is None or state.life != event.life or state.phase not in RUNNING:
                    self.stale += 1
                else:
                    self._hear(event, state)
            case _:
                assert_never(event)

    def _hear(
        self, event: Launched | NotLaunched | SignsSeen | NotAlive | Ended, state: ProcessState
    ) -> None:
        name, ready = event.name, self._specs[event.name].ready
        match event:
            case Launched():
                if state.phase == "starting" and not ready.signs and not ready.exits:
                    self._become_ready(name)
            case SignsSeen():
                if state.phase == "starting" and ready.signs:
                    self._become_ready(name)
            case NotLaunched(_, _, error):
                again = state.phase == "stopping" and not state.failing
                phase: Phase = "stopped" if not state.wanted else "pending" if again else "failed"
                self._change(name, phase=phase, reason=error, wanted=phase == "pending")
            case NotAlive(_, _, reason):
                if state.phase == "ready":
                    self._start_again(name, reason, failing=True)
            case Ended(_, _, status, reason):
                self._end(name, status, reason or status_text(status))

    # -- what somebody wants -----------------------------------------------------------------------

    def _declare(self, specs: Mapping[str, ProcessSpec]) -> None:
        for name in [name for name in self._specs if name not in specs]:
            self._undeclared.add(name)
            self._unwant(name)
        for name, spec in specs.items():
            self._undeclared.discard(name)
            changed = name in self._specs and self._specs[name] != spec
            if changed and self._states[name].phase in ("starting", "ready"):
                self._start_again(name, "declared anew")
            self._specs[name] = spec
            self._states.setdefault(name, ProcessState(life=self._forgotten_lives.pop(name, 0)))
            if changed and self._states[name].phase == "backing_off":
                self._change(name, phase="pending", in_a_row=0)
            if changed and self._states[name].phase == "exited":
                self._change(name, phase="stopped")
        # What has done its work and is declared as before has nothing left to do.
        for name in specs:
            if self._states[name].phase != "exited":
                self._want(name)

    def _want(self, name: str) -> None:
        """Let a process run, and those that it needs; one that has come to rest gets a new chance."""
        if name in self._undeclared:
            return
        for need in self._specs[name].needs:
            if not (self._states[need].phase == "exited" and _is_met(self._specs[need], self._states[need])):
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
            self._start_again(name, "to start again")
        elif self._states[name].phase != "stopping":
            self._change(name, phase="pending", reason="")
        self._change(name, in_a_row=0)
        self._want(name)

    # -- what happens ------------------------------------------------------------------------------

    def _become_ready(self, name: str) -> None:
        spec, due = self._specs[name], self._states[name].due
        self._change(name, phase="ready", until_s=self._now_s + spec.settled_s, reason="", due=due)
        if spec.alive is not None:
            self._actions.append(Probe(name))

    def _start_again(self, name: str, reason: str, *, failing: bool = False) -> None:
        """Stop a process that is to come again once those that restart with it have ended."""
        state, spec = self._states[name], self._specs[name]
        given_up = failing and (spec.restart == "never" or state.in_a_row >= spec.restarts)
        if given_up or not _restarting_with(name, self._specs, self._states):
            self._stop(name, reason, failing=failing)
        else:
            self._change(name, due=reason, failing=failing)

    def _stop(self, name: str, reason: str, *, failing: bool = False) -> None:
        stop = self._specs[name].stop
        until_s = self._now_s + stop.grace_s
        self._change(name, phase="stopping", until_s=until_s, reason=reason, failing=failing, killed=False)
        self._actions.append(Ask(name, stop.number))

    def _end(self, name: str, status: int, how: str) -> None:
        state, spec = self._states[name], self._specs[name]
        why = (state.due or state.reason) if state.failing else how
        self._change(name, status=status)
        if not state.wanted:
            self._change(name, phase="stopped", reason=how)
        elif state.phase == "stopping" and not state.failing:
            self._change(name, phase="pending")
        elif status == 0 and not state.failing and spec.restart != "always":
            self._change(name, phase="exited", reason=how, wanted=False)
        elif spec.restart == "never":
            self._change(name, phase="failed", reason=why, wanted=False)
        elif state.in_a_row >= spec.restarts:
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
                self._stop(name, f"not ready within {within_s:g} s", failing=True)
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
        """Start and stop what the dependencies allow by now, and forget what is not declared any more."""
        for name, why in _due(self._specs, self._states).items():
            self._change(name, due=why)
        for name, state in list(self._states.items()):
            if name in self._undeclared and state.phase in AT_REST:
                self._undeclared.discard(name)
                self._forgotten_lives[name] = state.life
                del self._states[name], self._specs[name]
            elif state.phase == "pending":
                self._launch_if_met(name)
            elif (
                state.phase in ("starting", "ready")
                and not state.wanted
                and not _is_needed(name, self._specs, self._states)
            ):
                self._stop(name, "")
            elif state.due and not _restarting_with(name, self._specs, self._states):
                self._stop(name, state.due, failing=state.failing)

    def _launch_if_met(self, name: str) -> None:
        missing = [
            need for need in self._specs[name].needs if not _is_met(self._specs[need], self._states[need])
        ]
        ending = _restarting_with(name, self._specs, self._states)
        if missing or ending:
            reasons = [f"needs {', '.join(missing)}"] if missing else []
            reasons += [f"waits for the end of {', '.join(ending)}"] if ending else []
            self._change(name, reason="; ".join(reasons))
            return
        spec, life = self._specs[name], self._states[name].life + 1
        until_s = self._now_s + spec.ready.within_s
        self._change(
            name, phase="starting", life=life, until_s=until_s, reason="", failing=False, killed=False
        )
        self._actions.append(Launch(name, life, spec))

    def _change(self, name: str, **fields: object) -> None:
        """A new phase has no end, and nothing due, unless one is given."""
        if "phase" in fields:
            fields = {"until_s": NEVER_S, "due": "", **fields}
        self._states[name] = replace(self._states[name], **fields)  # type: ignore[arg-type]


def _is_met(spec: ProcessSpec, state: ProcessState) -> bool:
    """Whether others that need this process may start."""
    done = spec.ready.exits and state.phase == "exited" and state.status == 0
    return (state.phase == "ready" and not state.due) or done


def _is_needed(name: str, specs: Mapping[str, ProcessSpec], states: Mapping[str, ProcessState]) -> bool:
    """Whether a process that is to end as well still runs and needs this one."""
    return any(
        name in spec.needs and not states[other].wanted and states[other].phase in RUNNING
        for other, spec in specs.items()
    )


def _restarting_with(
    name: str, specs: Mapping[str, ProcessSpec], states: Mapping[str, ProcessState]
) -> list[str]:
    """The processes that run and have to end before this one starts again."""
    return [one for one in specs if name in specs[one].restarts_with and states[one].phase in RUNNING]


def _due(specs: Mapping[str, ProcessSpec], states: Mapping[str, ProcessState]) -> dict[str, str]:
    """The processes that have to start again because one that they restart with does, and why."""
    found: dict[str, str] = {}
    waiting = [name for name, state in states.items() if state.due or state.phase in BEFORE_A_START]
    while waiting:
        name = waiting.pop()
        for one in _restarting_with(name, specs, states):
            if states[one].phase != "stopping" and not states[one].due and one not in found:
                found[one] = f"restarts with {name}"
                waiting.append(one)
    return found
