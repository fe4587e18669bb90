"""Outcomes that were proven are those of flights, to the byte; what is not proven is flown."""

import os
import signal
import threading
import time
from pathlib import Path

import pytest

from deploy.errors import DisturbedFlightError
from deploy.mission.flight import FlownMission, fly
from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from deploy.pairing.proofs import can_be_proven
from deploy.pairing.strike_pass import strike
from injector.strikes.results import StrikeRecord
from services.kernels import KERNELS, PLANNERS
from services.models.detection import DetectorSpec
from services.models.equipment import Link
from services.models.faults.specification import FaultSpec, Site, Trigger
from services.models.mission import Limits, MissionSpec
from services.models.outcome import Proof
from tests.bench.proofs import comparable
from tests.conftest import descendants, forked

SHORT = MissionSpec(seed=7, limits=Limits(mission_time_s=4.0))


def struck(kernel: str, call: int, seed: int) -> FaultSpec:
    return FaultSpec(target=kernel, seed=seed, trigger=Trigger(invocation=call))


@pytest.fixture(scope="module")
def twin(server: ForkServer) -> FlownMission:
    return fly(SHORT, server, keep_messages=True)


GAUSSIAN = DetectorSpec(scheme="gaussian")


@pytest.mark.parametrize(
    ("kernel", "call", "fields"),
    [
        ("pid", 40, {}),
        ("octomap", 3, {}),
        ("rrt_star", 0, {}),
        ("pid", 40, {"detector": GAUSSIAN}),
        ("collision_check", 5, {"detector": GAUSSIAN}),
        ("pid", 40, {"link": Link(delay_ms=30.0, loss=0.1)}),
    ],
)
def test_what_is_proven_is_what_is_flown(
    server: ForkServer, kernel: str, call: int, fields: dict[str, object]
) -> None:
    faults = [struck(kernel, call, seed) for seed in range(6)]
    mission = SHORT.model_copy(update=fields)
    proving, flying = PairFlyer(server), PairFlyer(server)
    kinds = set()
    for place, fault in enumerate(faults):
        spec = mission.model_copy(update={"fault": fault})
        proven = proving.fly(spec, ahead=faults[place + 1 :])
        flown = flying.fly(spec)
        assert comparable(proven) == comparable(flown)
        kinds.add(proven.proof.by if proven.proof is not None else "flown")
    assert kinds & {"same_memory", "same_messages"}
    assert not forked(server.pid)


@pytest.mark.parametrize(
    "kernel", ["point_cloud", "octomap", "collision_check", *PLANNERS, "trajectory", "pid"]
)
def test_of_a_fault_without_a_flip_the_memory_is_the_same(server: ForkServer, kernel: str) -> None:
    planner = kernel if kernel in PLANNERS else SHORT.planner
    twin = fly(SHORT.model_copy(update={"planner": planner}), server, keep_messages=True)
    calls = (0,) if KERNELS[kernel].stage == "planning" else (2, 8)
    none = [struck(kernel, call, 0).model_copy(update={"model": "none"}) for call in calls]
    assert {one.result for one in strike(server, twin, none)} == {"same_memory"}


def test_one_flight_stands_for_all_deaths_by_signals_in_a_call(server: ForkServer, tmp_path: Path) -> None:
    ways = ({"register_class": "gpr", "bit_numbers": (46,)}, {"model": "opcode", "bits": 4})
    crash = [struck("pid", 30, seed).model_copy(update=way) for way in ways for seed in range(12)]
    pairs = PairFlyer(server)
    pairs.proofs.flown.share(tmp_path)
    outcomes = [
        pairs.fly(SHORT.model_copy(update={"fault": one}), ahead=crash[place + 1 :])
        for place, one in enumerate(crash)
    ]
    causes = [" ".join(one.nodes["control"].causes) for one in outcomes]
    signals = [cause if cause.startswith("SIG") else "" for cause in causes]
    assert len({*signals} - {""}) > 1, "deaths of several kinds"
    died = [one for one, cause in zip(outcomes, signals, strict=True) if cause]
    assert [one.proof.by if one.proof is not None else "" for one in died] == [
        "",
        *["same_death"] * (len(died) - 1),
    ]
    first = next(filter(None, signals))
    other = next(place for place, cause in enumerate(signals) if cause not in ("", first))
    flown = PairFlyer(server).fly(SHORT.model_copy(update={"fault": crash[other]}))
    assert comparable(outcomes[other]) == comparable(flown)

    # Nor does anybody else who has the folder fly that class.
    stranger = PairFlyer(server)
    stranger.proofs.flown.share(tmp_path)
    found = stranger.fly(SHORT.model_copy(update={"fault": crash[signals.index(first)]}), ahead=[])
    assert found.proof == Proof(by="same_death")
    assert comparable(found) == comparable(died[0])


def test_a_pass_takes_as_many_faults_as_one_likes(server: ForkServer, twin: FlownMission) -> None:
    """A message to the striker would have had no room for them."""
    faults = [struck("pid", 5000, seed) for seed in range(2000)]
    assert {one.cause for one in strike(server, twin, faults)} == {"the flight ended before that call"}


def test_a_call_that_does_not_come_is_left_to_a_flight(server: ForkServer, twin: FlownMission) -> None:
    (told,) = strike(server, twin, [struck("pid", 5000, 0)])
    assert told == StrikeRecord(index=0, result="undecided", cause="the flight ended before that call")


@pytest.mark.parametrize("victim", ["zenfi-control", "zenfi-striker"])
def test_a_pass_that_is_disturbed_is_no_result(server: ForkServer, twin: FlownMission, victim: str) -> None:
    def kill() -> None:
        deadline = time.monotonic() + 20
        while time.monotonic() < deadline:
            called = [pid for pid in descendants(server.pid) if _name(pid) == victim]
            if called:
                time.sleep(0.3)
                os.kill(min(called), signal.SIGKILL)  # its copies come later
                return
            time.sleep(0.005)

    killer = threading.Thread(target=kill)
    killer.start()
    with pytest.raises(DisturbedFlightError):
        list(strike(server, twin, [struck("pid", call, 0) for call in range(90)]))
    killer.join()
    assert not forked(server.pid)


def _name(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/comm").read_text().strip()
    except OSError:
        return ""


def test_only_one_instruction_that_is_still_to_be_drawn_can_be_proven() -> None:
    drawn = struck("pid", 1, 0)
    site = Trigger(invocation=1, site=Site(precision="exact"))
    assert can_be_proven(drawn)
    assert not can_be_proven(None)
    assert not can_be_proven(FaultSpec(target="pid"))
    assert not can_be_proven(drawn.model_copy(update={"trigger": site}))
    assert not can_be_proven(FaultSpec(level="source", target="command.vx", trigger=Trigger(invocation=1)))
