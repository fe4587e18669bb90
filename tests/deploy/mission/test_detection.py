"""A detector in flight: it repeats, finds what strikes a message, and never takes the vehicle with it."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from deploy.config.check import check
from deploy.config.definitions import inlined
from deploy.config.platform import load_platform
from deploy.config.processes import STACK
from deploy.errors import BadSpecError
from deploy.mission import silence
from deploy.mission.flight import fly
from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from deploy.pairing.replay import replay
from detector.schemes.model_files import BadModelError
from detector.schemes.registry import MODELS, with_models
from services.bus.topics import STAGES
from services.models.detection import DetectorSpec
from services.models.faults.specification import FaultSpec
from services.models.mission import Limits, MissionSpec
from services.models.outcome import Outcome
from services.models.platform import KernelLatency, PlatformDefinition

SHORT = Limits(mission_time_s=8.0, hang_cpu_s=1.0)


def spec(detector: dict[str, object], **fields: object) -> MissionSpec:
    return MissionSpec.model_validate({"seed": 7, "limits": SHORT, "detector": detector, **fields})


@pytest.mark.soak
@pytest.mark.parametrize("scheme", with_models())
def test_a_watched_golden_flight_repeats_and_takes_the_time_of_its_checks(
    scheme: str, server: ForkServer
) -> None:
    asked = spec({"scheme": scheme, "check_us": 50.0})
    bare = fly(asked.model_copy(update={"detector": None}), server).outcome
    first, second = (fly(asked, server).outcome for _ in range(2))
    assert first.digest == second.digest != bare.digest
    assert first.detection is not None
    assert first.detection == second.detection
    assert not first.detection.alarms
    assert first.detection.ungated == 0
    judged = sum(first.topics[name].messages for name in ("collision_check", "trajectory", "command"))
    assert first.detection.checks == judged <= first.nodes["detector"].kernels[scheme].invocations
    assert first.detection.detection_share == pytest.approx(50e-6 * judged / 8.0, rel=0.02)
    assert first.qof.distance_m == pytest.approx(bare.qof.distance_m, rel=0.01)


@pytest.mark.soak
def test_a_check_that_takes_no_time_leaves_the_flight_as_it_is(server: ForkServer) -> None:
    asked = spec({"scheme": "kinematic", "check_us": 0.0})
    bare = fly(asked.model_copy(update={"detector": None}), server).outcome
    assert bare.detection is None
    assert "detector" not in bare.nodes
    assert fly(asked, server).outcome.digest == bare.digest


def test_a_struck_command_is_found_and_never_flown(server: ForkServer) -> None:
    struck = FaultSpec(level="source", target="command.vx", bit_numbers=(62,), seed=4)
    held, free = (
        PairFlyer(server).fly(spec({"scheme": "gaussian", "recovery": recovery}, fault=struck))
        for recovery in ("all", "off")
    )
    for outcome, action in ((held, "recomputed"), (free, "published")):
        assert outcome.injection is not None
        assert outcome.injection.status == "injected"
        assert outcome.detection is not None
        first = outcome.detection.alarms[0]
        assert (first.stage, first.state, first.action) == ("control", "command.vx", action)
        assert first.true
        assert first.virtual_time_ns >= outcome.injection.virtual_time_ns
    assert held.nodes["control"].recomputed == 1
    assert replay(held, server).answer == "replayed"
    assert off_course_m(held) < off_course_m(free)


def off_course_m(outcome: Outcome) -> float:
    assert outcome.golden is not None
    return abs(outcome.qof.distance_m - outcome.golden.qof.distance_m)


@pytest.fixture(scope="module")
def watched(server: ForkServer) -> dict[str, Outcome]:
    """The golden flight, by the gate of its detector."""
    return {gate: fly(spec({"scheme": "gaussian", "gate": gate}), server).outcome for gate in ("on", "off")}


@pytest.mark.soak
@pytest.mark.parametrize(
    ("fixture", "result", "cause"),
    [
        ("detector_dies", "crash", "SIGSEGV"),
        ("detector_hangs", "hang", "hang"),
        ("detector_sleeps", "hang", "hang"),
    ],
)
@pytest.mark.parametrize("gate", ["on", "off"])
def test_a_detector_that_fails_stops_nobody(
    fixture: str,
    result: str,
    cause: str,
    gate: str,
    watched: dict[str, Outcome],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    golden = watched[gate]
    monkeypatch.setattr(silence, "STALL_S", 3.0)
    asked = spec({"scheme": "gaussian", "gate": gate})
    module = f"tests.fixtures.nodes.{fixture}"
    failing = ForkServer({**STACK, "detector": replace(STACK["detector"], module=module)})
    try:
        outcome = fly(asked, failing).outcome
    finally:
        failing.close()
    report = outcome.nodes["detector"]
    assert (report.result, report.causes, report.restarts) == (result, [cause], 0)
    # Golden outputs are sound, so to go without verdicts changes nothing.
    assert outcome.digest == golden.digest
    assert outcome.detection is not None
    assert outcome.detection.ungated == sum(outcome.nodes[stage].ungated for stage in STAGES)
    commands = outcome.topics["command"].messages
    assert commands - 100 <= outcome.nodes["control"].ungated <= commands - 90
    assert golden.detection is not None
    assert golden.detection.ungated == 0


def test_a_stage_that_comes_back_does_not_wait_for_a_dead_detector() -> None:
    modules = {"detector": "detector_dies", "control": "crashes"}
    table = {
        name: replace(STACK[name], module=f"tests.fixtures.nodes.{module}")
        for name, module in modules.items()
    }
    failing = ForkServer({**STACK, **table})
    try:
        first, second = (fly(spec({"scheme": "gaussian"}), failing).outcome for _ in range(2))
    finally:
        failing.close()
    assert [first.nodes[name].result for name in modules] == ["crash", "crash"]
    assert first.nodes["control"].restarts == 1
    assert first.result == "timeout"
    assert first.digest == second.digest


def test_what_cannot_be_had_is_refused() -> None:
    with pytest.raises(BadSpecError, match="unknown detector 'wings'; installed: autoencoder, gaussian"):
        check(spec({"scheme": "wings"}))
    with pytest.raises(BadSpecError, match="no model comes along"):
        check(spec({"scheme": "gaussian-raw"}))
    bare = PlatformDefinition(name="bare", source="", kernels={"pid": KernelLatency(mean_ms=1.0)})
    kernels = dict.fromkeys(load_platform("ideal").kernels, KernelLatency(mean_ms=1.0))
    bare = bare.model_copy(update={"kernels": kernels})
    with pytest.raises(BadSpecError, match="no latency for detector gaussian: give its check_us"):
        check(spec({"scheme": "gaussian"}, platform=bare))
    check(spec({"scheme": "gaussian", "check_us": 1.0}, platform=bare))


def spoilt(change: str, text: str) -> str:
    content = json.loads(text)
    layers = content["parameters"].get("layers", [])
    if change == "truncated":
        return text[: len(text) // 2]
    if change == "NaN":
        content["parameters"]["threshold"] = float("nan")
    elif change == "shape":
        layers[0]["weight"] = layers[0]["weight"][:-1]
    else:
        content["states"]["control"] = content["states"]["control"][:-1]
    return json.dumps(content)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ("truncated", "not a model file, or truncated"),
        ("NaN", "NaN is no number"),
        ("shape", "a layer is not 13 to 6"),
        ("states", "trained for other states"),
    ],
)
def test_a_spoilt_model_is_refused_by_name(change: str, complaint: str, tmp_path: Path) -> None:
    file = tmp_path / "mine.json"
    file.write_text(spoilt(change, (MODELS / "autoencoder.json").read_text()))
    with pytest.raises(BadModelError, match=rf"mine.json: .*{complaint}"):
        inlined({"detector": {"scheme": "autoencoder", "model": str(file)}})


def test_a_model_travels_in_the_specification() -> None:
    file = str(MODELS / "kinematic.json")
    fields = inlined({"detector": {"scheme": "kinematic", "model": file}})
    asked = MissionSpec.model_validate(fields)
    check(asked)
    assert asked.detector is not None
    assert asked.detector.model == json.loads(Path(file).read_text())
    assert MissionSpec.model_validate_json(asked.model_dump_json()) == asked
    wrong = asked.model_copy(update={"detector": DetectorSpec(scheme="gaussian", model=asked.detector.model)})
    with pytest.raises(BadSpecError, match="a model of 'kinematic', not of 'gaussian'"):
        check(wrong)
