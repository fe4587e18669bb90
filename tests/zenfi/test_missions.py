"""``zenfi.fly``: what the command flies, given in Python; refusals are one line."""

import os
import signal
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pytest

import zenfi
from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec
from tests.conftest import PATIENCE_S
from tests.dashboard.command import zenfi as command
from zenfi.missions import _local, mission_of

WRITTEN = "source:trajectory.x,field=exponent"


def test_a_flight_is_that_of_the_command_and_of_a_campaign(server: ForkServer) -> None:
    here = zenfi.fly(seed=7, fault=WRITTEN, fault_seed=1)
    there = PairFlyer(server).fly(here.spec)
    assert here.result == "success"
    assert here.injection is not None
    assert here.injection.status == "injected"
    assert here.golden is not None
    assert (here.digest, here.golden.digest) == (there.digest, there.golden.digest if there.golden else "")
    typed = zenfi.Outcome.model_validate_json(
        command("fly", "--seed", 7, "--fault", WRITTEN, "--fault-seed", 1, "--json").stdout
    )
    assert typed.digest == here.digest
    assert typed.spec == here.spec


def test_a_fault_is_a_text_fields_or_a_specification() -> None:
    written = mission_of(fault=WRITTEN, fault_seed=4).fault
    fields = {"level": "source", "target": "trajectory.x", "field": "exponent", "seed": 4}
    assert written is not None
    assert mission_of(fault=fields).fault == written.model_copy(update={"trigger": None})
    assert mission_of(fault=FaultSpec.model_validate(fields)).fault == FaultSpec.model_validate(fields)


def test_fields_are_those_of_a_mission_and_replace_what_a_specification_says() -> None:
    base = MissionSpec(world="dense", seed=3)
    assert mission_of(base, seed=4, pilot="baseline") == MissionSpec(world="dense", seed=4, pilot="baseline")
    assert mission_of(detector="gaussian,gate=off").detector is not None
    assert mission_of(profile="paper").camera.width == 256


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"world": "nowhere"}, "unknown world 'nowhere'"),
        ({"seed": -1}, "seed: .*greater than or equal to 0"),
        ({"sed": 1}, "sed: Extra inputs"),
        ({"fault": "pid"}, "fault 'pid': expected LEVEL:TARGET"),
        ({"fault": {"target": "pid", "bits": "two"}}, "bits: "),
        ({"fault": "instruction:nonsense"}, "nonsense"),
        ({"record": "no/such/folder/run.mcap"}, "there is no folder no/such/folder"),
    ],
)
def test_bad_input_is_one_line(given: dict[str, object], said: str) -> None:
    with pytest.raises(zenfi.BadSpecError, match=said) as refused:
        zenfi.fly(**given)  # type: ignore[arg-type]
    assert "\n" not in str(refused.value)


def test_a_recording_is_read_as_table(tmp_path: Path) -> None:
    outcome = zenfi.fly(seed=7, record=tmp_path / "run.mcap")
    run = zenfi.open_run(tmp_path / "run.mcap")
    assert run.spec == outcome.spec
    assert len(run.table("odometry").pandas()) == outcome.topics["odometry"].messages


def test_an_injected_flight_is_replayed() -> None:
    assert zenfi.replay(zenfi.fly(seed=7, fault=WRITTEN, fault_seed=1)).answer == "replayed"


def test_a_lost_fork_server_is_replaced() -> None:
    first = zenfi.fly(seed=7)
    assert _local.server is not None
    os.kill(_local.server.pid, signal.SIGKILL)
    assert _local.server.is_lost(within_s=PATIENCE_S)
    assert zenfi.fly(seed=7).digest == first.digest


def test_a_spawned_process_flies_and_a_forked_one_says_why_not() -> None:
    golden = zenfi.fly(seed=7)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        assert pool.submit(digest_of_a_flight, 7).result() == golden.digest
    with ProcessPoolExecutor(1, mp_context=get_context("fork")) as pool:
        refused = pool.submit(digest_of_a_flight, 7).exception()
    assert isinstance(refused, zenfi.InfrastructureError)
    assert "spawn" in str(refused)


def digest_of_a_flight(seed: int) -> str:
    return zenfi.fly(seed=seed).digest
