"""A program in the flight controller's place flies by PX4's simulator protocol, in lockstep."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from deploy.config.check import check
from deploy.errors import BadSpecError, InfrastructureError
from deploy.mission.flight import fly
from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from services.models.faults.specification import FaultSpec
from services.models.mission import Limits, MissionSpec
from services.models.own_stack import OwnStack
from sim.autopilot.px4 import open_ports
from tests.fixtures.own_stacks import read

STAND_IN = Path(__file__).parents[2] / "fixtures" / "px4_stand_in.py"


def autopilot(folder: Path, *command: str, **more: float) -> OwnStack:
    folder.mkdir(exist_ok=True)
    words = [sys.executable, *(command or (str(STAND_IN), "{instance}", "airsim"))]
    lines = ['name = "px4"', "[autopilot]", f"command = {words}"]
    file = folder / "autopilot.toml"
    file.write_text("\n".join([*lines, *(f"{name} = {value}" for name, value in more.items())]))
    return read(file)


@pytest.fixture(scope="module")
def stack(tmp_path_factory: pytest.TempPathFactory) -> OwnStack:
    return autopilot(tmp_path_factory.mktemp("autopilot"))


def mission(stack: OwnStack | None, **more: object) -> MissionSpec:
    return MissionSpec.model_validate({"world": "sparse", "seed": 7, "stack": stack, **more})


def test_it_flies_as_the_built_in_controller_does_and_the_same_again(
    stack: OwnStack, server: ForkServer
) -> None:
    """Same control law behind the protocol: what differs is rounding, velocities to a centimetre a second."""
    check(mission(stack))
    native = fly(mission(None), server).outcome
    first, again = fly(mission(stack), server).outcome, fly(mission(stack), server).outcome
    assert first.result == again.result == "success"
    assert first.digest == again.digest
    assert first.digest != native.digest
    assert first.qof.flight_time_s == pytest.approx(native.qof.flight_time_s, rel=0.02)
    assert first.qof.distance_m == pytest.approx(native.qof.distance_m, rel=0.02)
    assert first.qof.min_clearance_m == pytest.approx(native.qof.min_clearance_m, abs=0.2)


@pytest.mark.soak
def test_a_fault_is_struck_in_our_stages_as_ever(stack: OwnStack, server: ForkServer) -> None:
    fault = FaultSpec(target="pid", seed=3)
    pairs = PairFlyer(server)
    outcome, again = pairs.fly(mission(stack, fault=fault)), pairs.fly(mission(stack, fault=fault))
    assert outcome.injection is not None
    assert outcome.injection.status == "injected"
    assert outcome.digest == again.digest


def running(script: str) -> list[int]:
    """Processes whose command holds a word."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            if entry.name.isdigit() and script.encode() in (entry / "cmdline").read_bytes():
                found.append(int(entry.name))
        except OSError:
            continue
    return [pid for pid in found if pid != os.getpid()]


def test_nothing_is_left_of_it(tmp_path: Path, server: ForkServer) -> None:
    copy = tmp_path / "px4_stand_in_left.py"
    copy.write_text(STAND_IN.read_text().replace("Path(__file__).parents[2]", repr(str(STAND_IN.parents[2]))))
    own = autopilot(tmp_path, str(copy), "{instance}", "airsim")
    fly(mission(own, limits=Limits(mission_time_s=2.0)), server)
    assert running(copy.name) == []


def fails(stack: OwnStack, server: ForkServer) -> str:
    with pytest.raises(InfrastructureError) as failed:
        fly(mission(stack, limits=Limits(restarts=0, mission_time_s=3.0)), server)
    return str(failed.value)


def test_an_autopilot_that_dies_is_our_failure_and_no_result(tmp_path: Path, server: ForkServer) -> None:
    script = tmp_path / "dies.py"
    script.write_text(
        "import socket, sys\n"
        "link = socket.create_connection(('127.0.0.1', 4560 + int(sys.argv[1])))\n"
        "link.recv(100)\n"
        "sys.exit(3)\n"
    )
    assert "ended with status 3" in fails(autopilot(tmp_path, str(script), "{instance}"), server)


def test_flights_side_by_side_have_ports_of_their_own() -> None:
    """Also when the program has connected, and nobody listens any more."""
    door, radio, instance = open_ports()
    with radio:
        door.close()
        other_door, other_radio, other = open_ports()
        with other_door, other_radio:
            assert other > instance


def test_an_autopilot_boots_while_no_answer_is_awaited(tmp_path: Path, server: ForkServer) -> None:
    own = autopilot(tmp_path, boot_s=0.2, settle_s=0.4)
    outcome = fly(mission(own, limits=Limits(mission_time_s=2.0)), server).outcome
    assert outcome.result == "timeout"
    assert outcome.qof.distance_m > 0.5, "it was armed and flew"


def test_a_stack_replaces_something(tmp_path: Path) -> None:
    (tmp_path / "stack.toml").write_text('name = "nothing"')
    with pytest.raises(BadSpecError, match="it replaces nothing"):
        read(tmp_path / "stack.toml")
