"""The state machine of a stack under orders of events that nobody thought of."""

from collections.abc import Mapping

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

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
from deploy.compose.stack_file import BackOff, Liveness, ProcessSpec, Readiness, StopPolicy
from deploy.compose.state_machine import AT_REST, NEVER_S, RUNNING, ProcessState, StackStates

SHORT = BackOff(first_s=1, factor=2, most_s=3)


def spec(**fields: object) -> ProcessSpec:
    given = {"command": ("x",), "backoff": SHORT, "restarts": 2, "settled_s": 5, **fields}
    return ProcessSpec.model_validate(given)


HTTP = Readiness(http="http://localhost/", within_s=4)
ALIVE = Liveness(http="http://localhost/")
FIRST = {
    "once": spec(ready=Readiness(exits=True, within_s=4)),
    "base": spec(ready=HTTP, needs=("once",), restart="always", stop=StopPolicy(grace_s=2), alive=ALIVE),
    "side": spec(restart="never"),
    "top": spec(ready=HTTP, needs=("base", "side"), restarts_with=("base",), alive=ALIVE),
}
SECOND = {
    "base": spec(ready=HTTP, restart="on-failure", stop=StopPolicy(signal="SIGINT", grace_s=2)),
    "side": FIRST["side"],
    "new": spec(needs=("side",)),
}
STACKS = (FIRST, SECOND)
NAMES = ("once", "base", "side", "top", "new")
names = st.sampled_from(NAMES)
lives = st.integers(-1, 0)  # the present life of the process, or the one before
PLAIN = ("want", "unwant", "again", "launched", "not launched", "seen", "dead")
steps = st.one_of(
    st.tuples(st.just("declare"), st.sampled_from((0, 1)), lives),
    st.tuples(
        st.sampled_from(("want", "unwant", "again", "launched", "not launched", "seen", "dead")), names, lives
    ),
    st.tuples(st.just("ended"), names, lives, st.sampled_from((0, 1, -9))),
    st.tuples(st.just("passed"), st.floats(0, 6), lives),
)


class Watched:
    """A stack's states with a clock; every promise is checked at every event."""

    def __init__(self) -> None:
        self.states = StackStates()
        self.now_s = 0.0
        self.asked: set[tuple[str, int]] = set()
        self.killed: set[tuple[str, int]] = set()

    def handle(self, event: Event) -> list[Action]:
        before = dict(self.states.processes)
        actions = self.states.handle(event, self.now_s)
        for action in actions:
            self.check(action, before)
        for name, state in self.states.processes.items():
            assert state.in_a_row <= self.states.specs[name].restarts
            assert (state.phase in ("stopped", "exited", "failed")) <= (state.until_s == NEVER_S)
            if state.phase in ("starting", "stopping", "backing_off"):
                assert state.killed or state.until_s < NEVER_S
            if not state.wanted:
                assert state.phase not in ("pending", "backing_off")
        if isinstance(event, (Launched, NotLaunched, SignsSeen, NotAlive, Ended)):
            known = before.get(event.name)
            if known is None or known.life != event.life or known.phase not in RUNNING:
                assert not actions
                assert dict(self.states.processes) == before
        return actions

    def check(self, action: Action, before: Mapping[str, ProcessState]) -> None:
        name, states = action.name, self.states.processes
        life = states[name].life
        match action:
            case Launch(_, number, what):
                assert number == life
                assert before.get(name, ProcessState()).phase not in ("starting", "ready")
                assert states[name].wanted
                assert what == self.states.specs[name]
                for need in what.needs:
                    done = states[need].phase == "exited" and states[need].status == 0
                    assert states[need].phase == "ready" or done
                for other, others in self.states.specs.items():
                    assert not (name in others.restarts_with and states[other].phase in RUNNING)
            case Probe():
                assert states[name].phase == "ready"
                assert self.states.specs[name].alive is not None
            case Ask():
                assert (name, life) not in self.asked
                self.asked.add((name, life))
                if not states[name].wanted:
                    for other, what in self.states.specs.items():
                        unwanted = not states[other].wanted and states[other].phase in RUNNING
                        assert not (name in what.needs and unwanted)
            case Kill():
                assert (name, life) in self.asked
                assert (name, life) not in self.killed
                self.killed.add((name, life))

    def step(self, step: tuple[object, ...]) -> None:
        event = self.event(step)
        if event is not None:
            self.handle(event)

    def event(self, step: tuple[object, ...]) -> Event | None:
        kind, what, which = step[:3]
        if kind == "declare":
            return Declare(STACKS[int(str(what))])
        if kind == "passed":
            self.now_s += float(str(what))
            return TimePassed()
        name = str(what)
        if name not in self.states.processes:
            return None if kind in ("want", "unwant", "again") else SignsSeen(name, 1)
        life = self.states.processes[name].life + int(str(which))
        events: dict[str, Event] = {
            "want": Want((name,)),
            "unwant": Unwant((name,)),
            "again": Restart(name),
            "launched": Launched(name, life),
            "not launched": NotLaunched(name, life, "no such program"),
            "seen": SignsSeen(name, life),
            "dead": NotAlive(name, life, "does not answer"),
            "ended": Ended(name, life, int(str(step[3])) if len(step) > 3 else 0),
        }
        return events[str(kind)]

    def end_everything(self) -> None:
        """A world in which whatever was asked to end does."""
        for _ in range(20):
            for name, state in list(self.states.processes.items()):
                if state.phase == "stopping":
                    self.handle(Ended(name, state.life, -15))

    def let_it_work(self) -> None:
        """A world in which everything starts well."""
        for _ in range(30):
            self.now_s += 1
            self.handle(TimePassed())
            for name, state in list(self.states.processes.items()):
                if state.phase == "stopping":
                    self.handle(Ended(name, state.life, -15))
                elif state.phase == "starting":
                    self.handle(Launched(name, state.life))
                    once = self.states.specs[name].ready.exits
                    self.handle(Ended(name, state.life, 0) if once else SignsSeen(name, state.life))


stories = st.lists(steps, max_size=40)


@given(stories)
@settings(max_examples=200)
def test_any_order_of_events_keeps_the_promises(story: list[tuple[object, ...]]) -> None:
    stack = Watched()
    stack.handle(Declare(FIRST))
    for step in story:
        stack.step(step)


@given(stories)
@settings(max_examples=200)
def test_a_stack_that_is_let_go_comes_to_rest(story: list[tuple[object, ...]]) -> None:
    stack = Watched()
    stack.handle(Declare(FIRST))
    for step in story:
        stack.step(step)
    stack.handle(Unwant(tuple(stack.states.processes)))
    stack.end_everything()
    assert stack.states.at_rest


@given(stories)
@settings(max_examples=200)
def test_whatever_happened_a_stack_that_is_wanted_gets_ready(story: list[tuple[object, ...]]) -> None:
    stack = Watched()
    stack.handle(Declare(FIRST))
    for step in story:
        stack.step(step)
    stack.handle(Declare(FIRST))
    stack.let_it_work()
    stack.handle(Want(tuple(FIRST)))
    stack.let_it_work()
    assert {name: state.phase for name, state in stack.states.processes.items()} == {
        "once": "exited",
        "base": "ready",
        "side": "ready",
        "top": "ready",
    }


def alone(what: ProcessSpec) -> Watched:
    stack = Watched()
    stack.handle(Declare({"x": what}))
    return stack


def phase(stack: Watched) -> str:
    return stack.states.processes["x"].phase


def crash(stack: Watched, status: int = 1) -> None:
    stack.handle(Ended("x", stack.states.processes["x"].life, status))


@pytest.mark.parametrize(
    ("restart", "status", "then"),
    [
        ("never", 0, "exited"),
        ("never", 1, "failed"),
        ("on-failure", 0, "exited"),
        ("on-failure", 1, "backing_off"),
        ("on-failure", -11, "backing_off"),
        ("always", 0, "backing_off"),
        ("always", 1, "backing_off"),
    ],
)
def test_what_follows_an_end(restart: str, status: int, then: str) -> None:
    stack = alone(spec(restart=restart))
    stack.handle(Launched("x", 1))
    crash(stack, status)
    assert phase(stack) == then


def test_pauses_grow_until_restarts_are_used_up() -> None:
    stack = alone(spec(restarts=3))
    pauses = []
    while phase(stack) == "starting":
        crash(stack)
        if phase(stack) == "backing_off":
            pauses.append(stack.states.next_s - stack.now_s)
            stack.now_s = stack.states.next_s
            stack.handle(TimePassed())
    assert pauses == [1, 2, 3]
    assert phase(stack) == "failed"
    assert "3 restarts" in stack.states.processes["x"].reason


def test_restarts_are_counted_anew_once_it_has_settled() -> None:
    stack = alone(spec(restarts=1))
    for _ in range(5):
        crash(stack)
        stack.now_s = stack.states.next_s
        stack.handle(TimePassed())
        stack.handle(Launched("x", stack.states.processes["x"].life))
        stack.now_s += 5
        stack.handle(TimePassed())
    assert phase(stack) == "ready"
    assert stack.states.processes["x"].restarts == 5


def test_who_is_not_ready_in_time_is_stopped_then_killed_then_started_again() -> None:
    stack = alone(spec(ready=HTTP, stop=StopPolicy(grace_s=2)))
    stack.handle(Launched("x", 1))
    stack.now_s = 4
    assert stack.handle(TimePassed()) == [Ask("x", 15)]
    stack.now_s = 6
    assert stack.handle(TimePassed()) == [Kill("x")]
    crash(stack, -9)
    assert phase(stack) == "backing_off"
    assert "not ready within 4 s" in stack.states.processes["x"].reason


def test_a_need_that_restarts_leaves_its_dependants_alone() -> None:
    stack = Watched()
    stack.handle(Declare({"base": spec(), "top": spec(needs=("base",))}))
    stack.handle(Launched("base", 1))
    stack.handle(Launched("top", 1))
    stack.handle(Ended("base", 1, 1))
    assert stack.states.processes["top"].phase == "ready"


def pair(**base: object) -> Watched:
    """A process, and one that needs it and restarts with it; both are ready."""
    stack = Watched()
    specs = {"top": spec(needs=("base",), restarts_with=("base",)), "base": spec(alive=ALIVE, **base)}
    stack.handle(Declare(specs))
    stack.handle(Launched("base", 1))
    stack.handle(Launched("top", 1))
    return stack


def told(actions: list[Action]) -> list[tuple[str, str]]:
    return [(type(action).__name__, action.name) for action in actions]


def test_who_is_not_alive_starts_again_after_those_that_restart_with_it_have_ended() -> None:
    stack = pair()
    assert told(stack.handle(NotAlive("base", 1, "does not answer"))) == [("Ask", "top")]
    assert told(stack.handle(Ended("top", 1, -15))) == [("Ask", "base")]
    assert told(stack.handle(Ended("base", 1, -15))) == []
    base = stack.states.processes["base"]
    assert (base.phase, base.reason) == ("backing_off", "does not answer")
    stack.now_s = stack.states.next_s
    assert told(stack.handle(TimePassed())) == [("Launch", "base")]
    assert told(stack.handle(Launched("base", 2))) == [("Probe", "base"), ("Launch", "top")]


def test_who_crashes_starts_again_when_those_that_restart_with_it_have_ended() -> None:
    stack = pair()
    assert told(stack.handle(Ended("base", 1, 1))) == [("Ask", "top")]
    stack.now_s = stack.states.next_s
    assert told(stack.handle(TimePassed())) == []
    assert stack.states.processes["base"].reason == "waits for the end of top"
    assert told(stack.handle(Ended("top", 1, 0))) == [("Launch", "base")]
    assert told(stack.handle(Launched("base", 2))) == [("Probe", "base"), ("Launch", "top")]


@pytest.mark.parametrize("policy", [{"restart": "never"}, {"restarts": 0}])
def test_who_does_not_come_again_takes_nobody_along(policy: dict[str, object]) -> None:
    stack = pair(**policy)
    assert told(stack.handle(NotAlive("base", 1, "does not answer"))) == [("Ask", "base")]
    assert told(stack.handle(Ended("base", 1, -15))) == []
    assert stack.states.processes["base"].phase == "failed"
    assert stack.states.processes["base"].reason.startswith("does not answer")
    assert stack.states.processes["top"].phase == "ready"


CHANGED = Declare({**FIRST, "base": spec(ready=HTTP, command=("y",))})


@pytest.mark.parametrize("order", [Restart("base"), CHANGED], ids=["asked", "declared anew"])
def test_who_is_to_start_again_takes_those_along_that_restart_with_it(order: Event) -> None:
    stack = Watched()
    stack.handle(Declare(FIRST))
    stack.let_it_work()
    assert told(stack.handle(order)) == [("Ask", "top")]
    life = stack.states.processes["base"].life
    assert told(stack.handle(Ended("top", stack.states.processes["top"].life, 0))) == [("Ask", "base")]
    assert ("Launch", "base") in told(stack.handle(Ended("base", life, 0)))


def test_who_is_over_a_limit_has_failed_with_that_reason() -> None:
    stack = alone(spec(restart="never"))
    stack.handle(Launched("x", 1))
    stack.handle(Ended("x", 1, -9, "over its limit of memory"))
    state = stack.states.processes["x"]
    assert (state.phase, state.status, state.reason) == ("failed", -9, "over its limit of memory")


def test_only_what_is_declared_anew_starts_anew() -> None:
    stack = Watched()
    stack.handle(Declare({"same": spec(), "other": spec(), "gone": spec()}))
    for name in ("same", "other", "gone"):
        stack.handle(Launched(name, 1))
    actions = stack.handle(Declare({"same": spec(), "other": spec(command=("y",)), "more": spec()}))
    assert [(type(action).__name__, action.name) for action in actions] == [
        ("Ask", "other"),
        ("Ask", "gone"),
        ("Launch", "more"),
    ]
    stack.end_everything()
    assert set(stack.states.processes) == {"same", "other", "more"}
    assert stack.states.specs["other"].command == ("y",)
    assert AT_REST == ("stopped", "exited", "failed")
