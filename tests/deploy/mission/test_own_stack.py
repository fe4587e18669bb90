"""A program in C++ that knows nothing of Zenoh flies a mission, is struck, and the flight repeats."""

import shutil
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from deploy.config.check import check
from deploy.config.processes import STACK
from deploy.errors import BadSpecError, InfrastructureError
from deploy.mission.flight import fly
from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from injector.tracing.symbols import demangled
from services.models.faults.specification import FaultSpec
from services.models.mission import Limits, MissionSpec
from services.models.outcome import Outcome
from services.models.own_stack import OwnStack
from tests.conftest import forked
from tests.fixtures.own_stacks import compiled, read, scripted

pytestmark = pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler here")


@pytest.fixture(scope="module")
def stack(tmp_path_factory: pytest.TempPathFactory) -> OwnStack:
    return read(compiled(tmp_path_factory.mktemp("own")))


@pytest.fixture(scope="module")
def pairs(server: ForkServer) -> PairFlyer:
    return PairFlyer(server)


def mission(stack: OwnStack, **more: object) -> MissionSpec:
    return MissionSpec.model_validate({"world": "sparse", "seed": 7, "stack": stack, **more})


def struck(pairs: PairFlyer, stack: OwnStack, seed: int, **what: object) -> Outcome:
    fault = FaultSpec.model_validate({"target": "control", "seed": seed, **what})
    spec = mission(stack, fault=fault)
    check(spec)
    return pairs.fly(spec)


def test_it_flies_to_the_goal_and_the_same_again(stack: OwnStack, server: ForkServer) -> None:
    first, again = fly(mission(stack), server).outcome, fly(mission(stack), server).outcome
    assert first.result == "success"
    assert first.nodes["control"].result == "golden"
    assert first.nodes["control"].kernels["control"].invocations >= first.topics["command"].messages > 100
    assert first.digest == again.digest
    native = fly(MissionSpec(world="sparse", seed=7), server).outcome
    assert first.topics["command"].digest != native.topics["command"].digest


def test_it_is_struck_and_the_record_names_instruction_and_symbol(stack: OwnStack, pairs: PairFlyer) -> None:
    outcome = struck(pairs, stack, 3, operand="source", register_class="vector", field="exponent")
    record = outcome.injection
    assert record is not None
    assert (record.status, record.precision, record.node) == ("injected", "exact", "control")
    assert record.module == "pursuit"
    assert demangled(record.symbol).startswith("pursue(")
    assert record.instruction
    assert record.build_id
    assert int(record.before, 16) ^ int(record.read_back, 16) == 1 << record.bits[0]
    assert outcome.golden is not None
    again = struck(pairs, stack, 3, operand="source", register_class="vector", field="exponent")
    assert again.digest == outcome.digest
    assert again.injection is not None
    volatile = {"pid", "tid", "pause_us"}
    assert again.injection.model_dump(exclude=volatile) == record.model_dump(exclude=volatile)


def test_python_code_is_struck(tmp_path: Path, pairs: PairFlyer) -> None:
    compiled(tmp_path)
    file = tmp_path / "pursuit_python.toml"
    file.write_text(file.read_text().replace('"python3"', f'"{sys.executable}"'))
    stack = read(file)
    outcome = struck(pairs, stack, 4)
    assert outcome.golden is not None
    assert outcome.golden.result == "success"
    record = outcome.injection
    assert record is not None
    assert (record.status, record.precision, record.node) == ("injected", "exact", "control")
    assert "python" in record.module
    again = struck(pairs, stack, 4)
    assert again.digest == outcome.digest
    assert again.injection is not None
    assert (again.injection.offset, again.injection.before) == (record.offset, record.before)


def test_a_struck_flight_replays_from_what_its_outcome_says(stack: OwnStack, pairs: PairFlyer) -> None:
    outcome = struck(pairs, stack, 5)
    replayed = pairs.fly(outcome.spec)
    assert replayed.digest == outcome.digest
    assert replayed.injection is not None
    assert outcome.injection is not None
    assert replayed.injection.probes == 0
    for name in ("status", "offset", "instruction", "before", "after", "bits"):
        assert getattr(replayed.injection, name) == getattr(outcome.injection, name), name


def test_one_that_dies_of_it_is_started_again(stack: OwnStack, pairs: PairFlyer, server: ForkServer) -> None:
    """A high bit of a register that holds an address, until one is used."""
    for seed in range(20):
        outcome = struck(
            pairs, stack, seed, operand="source", register_class="gpr", bit_numbers=(45,), bits=1
        )
        if outcome.nodes["control"].crashes:
            break
    control = outcome.nodes["control"]
    assert control.causes == ["SIGSEGV"]
    assert control.restarts == 1
    assert not forked(server.pid)


def test_a_message_of_it_is_struck(stack: OwnStack, pairs: PairFlyer) -> None:
    fault = FaultSpec(level="source", target="command.vx", seed=1)
    outcome = pairs.fly(mission(stack, fault=fault))
    assert outcome.injection is not None
    assert outcome.injection.status == "injected"
    assert outcome.topics["command"].diverged_at_s == outcome.injection.virtual_time_ns / 1e9


def test_one_that_hangs_is_killed_and_started_again(tmp_path: Path, server: ForkServer) -> None:
    script = """
steps = 0
for words, body in lines():
    if words[0] == b"zenfi":
        life = int(words[3])
        say("ready")
    if words[0] == b"step":
        steps += 1
        while steps == 30 and not life:
            pass
        say(f"put command {len(TWIST)}", TWIST)
        say("done")
"""
    limits = Limits(mission_time_s=4.0, hang_cpu_s=0.5)
    flight = fly(mission(scripted(tmp_path, script), limits=limits), server)
    assert flight.outcome.result == "timeout"
    assert flight.outcome.nodes["control"].hangs == 1
    assert flight.outcome.nodes["control"].restarts == 1
    assert not forked(server.pid)


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        ('say("fine")', "expected: put TOPIC BYTES, or done; got ['fine']"),
        ('say("put trajectory 4", b"abcd"); say("done")', "control publishes command, not 'trajectory'"),
        ('say("put command 4", b"abcd"); say("done")', "command: geometry_msgs/msg/TwistStamped"),
        ("sys.exit(0)", "it left before the mission's end"),
    ],
)
def test_nonsense_of_a_healthy_program_is_told(
    answer: str, told: str, tmp_path: Path, server: ForkServer
) -> None:
    script = f"""
for words, body in lines():
    if words[0] == b"zenfi":
        say("ready")
    if words[0] == b"step":
        {answer}
"""
    with pytest.raises(InfrastructureError, match="control: ") as refused:
        fly(mission(scripted(tmp_path, script)), server)
    assert told in str(refused.value)
    assert not forked(server.pid)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"fault": {"target": "pid"}}, "strike 'control'"),
        ({"fault": {"target": "control", "scope": "kernel"}}, "scope kernel goes with our own kernels"),
        ({"clock": "realtime"}, "leave out --clock realtime"),
    ],
)
def test_what_cannot_be_is_refused(stack: OwnStack, change: dict[str, object], told: str) -> None:
    with pytest.raises(BadSpecError, match=told):
        check(mission(stack, **change))


def test_a_program_that_was_built_anew_is_refused(tmp_path: Path) -> None:
    stack = read(compiled(tmp_path))
    with (tmp_path / "pursuit").open("ab") as file:
        file.write(b"more")
    with pytest.raises(BadSpecError, match="is not what it was"):
        check(mission(stack))


@pytest.mark.parametrize("options", [["-I"], ["-u", "-sE"]])
def test_python_that_hashes_at_random_is_refused(options: list[str], tmp_path: Path) -> None:
    stack = scripted(tmp_path, "", options=options)
    with pytest.raises(BadSpecError, match=f"with {options[-1]}, Python hashes strings by a random number"):
        check(mission(stack))


def test_without_a_function_no_instruction_of_it_can_be_struck(tmp_path: Path) -> None:
    stack = scripted(tmp_path, "")
    with pytest.raises(BadSpecError, match="names no function"):
        check(mission(stack, fault=FaultSpec(target="control")))


@pytest.mark.parametrize("first", ["#!/usr/bin/env bash", "#!/bin/sh"])
def test_a_launcher_is_not_struck(tmp_path: Path, first: str) -> None:
    """As pyenv's: its ``python3`` is a script that starts the real one."""
    compiled(tmp_path)
    (tmp_path / "launcher").write_text(f'{first}\nexec ./pursuit "$@"\n')
    (tmp_path / "launcher").chmod(0o755)
    file = tmp_path / "pursuit.toml"
    file.write_text(file.read_text().replace("./pursuit", "./launcher"))
    stack = read(file)
    check(mission(stack))
    with pytest.raises(BadSpecError, match=rf"{tmp_path}/launcher: \w+ only starts another program.*name it"):
        check(mission(stack, fault=FaultSpec(target="control")))


@pytest.mark.soak
def test_nobody_has_a_process_announced_that_is_not_its_own() -> None:
    module = "tests.fixtures.nodes.claims_another"
    server = ForkServer({**STACK, "control": replace(STACK["control"], module=module)})
    try:
        with pytest.raises(InfrastructureError, match="which is none of its own"):
            fly(MissionSpec(seed=7, limits=Limits(restarts=0)), server)
    finally:
        server.close()
