"""Source-level faults in flight: they repeat, need no injector, and are compared with the golden twin."""

import pytest

from deploy.config.check import check
from deploy.errors import BadSpecError
from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from deploy.pairing.replay import replay
from services.models.faults.specification import FaultSpec
from services.models.mission import Limits, MissionSpec
from services.models.outcome import Outcome

SHORT = Limits(mission_time_s=6.0)


def spec(**fault: object) -> MissionSpec:
    given = FaultSpec.model_validate({"level": "source", **fault})
    return MissionSpec(seed=7, limits=SHORT, fault=given)


def test_a_struck_command_moves_the_vehicle_and_repeats(server: ForkServer) -> None:
    outcome = PairFlyer(server).fly(spec(target="command.vx", field="sign", seed=4))
    assert outcome.injection is not None
    assert outcome.injection.status == "injected"
    assert outcome.injection.node == "control"
    assert outcome.nodes["control"].result == "sdc"
    struck_s = outcome.injection.virtual_time_ns / 1e9
    assert outcome.topics["command"].diverged_at_s == pytest.approx(struck_s)
    moved_s = outcome.topics["odometry"].diverged_at_s
    assert moved_s is None or moved_s > struck_s
    assert replay(outcome, server).answer == "replayed"


def test_an_unknown_state_or_field_is_refused() -> None:
    with pytest.raises(BadSpecError, match="unknown inter-kernel state 'wings'"):
        check(spec(target="wings"))
    with pytest.raises(BadSpecError, match="32-bit integer"):
        check(spec(target="collision_check.future_collision_seq", field="sign"))


@pytest.mark.parametrize(
    ("fields", "most"),
    [
        ({"mask": "byte", "components": "all"}, 3 * 8),
        ({"mask": "histogram", "histogram": {"masks": {"0x3": 0.5, "0x8000000000000": 0.5}}}, 2),
    ],
    ids=("byte", "histogram"),
)
def test_a_mask_is_drawn_read_back_and_repeats(
    fields: dict[str, object], most: int, server: ForkServer
) -> None:
    outcome = PairFlyer(server).fly(spec(target="command.velocity", seed=4, **fields))
    record = outcome.injection
    assert record is not None
    assert record.status == "injected"
    changed = int(record.before, 16) ^ int(record.read_back, 16)
    assert [bit for bit in range(record.width_bits) if changed >> bit & 1] == record.bits
    assert len(record.bits) <= most
    assert (
        replay(Outcome.model_validate_json(outcome.model_dump_json(by_alias=True)), server).answer
        == "replayed"
    )


@pytest.mark.parametrize(
    "recurrence",
    [
        {"recurrence": "intermittent", "probability": 0.2},
        {"recurrence": "permanent", "from_s": 2.0, "until_s": 3.0},
        {"recurrence": "rate", "rate_hz": 4.0},
    ],
    ids=lambda one: str(one["recurrence"]),
)
def test_a_fault_that_comes_back_is_counted_and_repeats(
    recurrence: dict[str, object], server: ForkServer
) -> None:
    outcome = PairFlyer(server).fly(spec(target="command.velocity", bit_numbers=[51], **recurrence))
    record = outcome.injection
    assert record is not None
    assert record.status == "injected"
    assert record.strikes == len(record.struck) > 5
    assert record.struck[0].virtual_time_ns == record.virtual_time_ns
    struck = [one.invocation for one in record.struck]
    # A message that a detector may see before it is published is struck once; two upsets may come in one.
    assert struck == sorted(struck if "rate_hz" in recurrence else set(struck))
    assert outcome.topics["command"].diverged_at_s == pytest.approx(record.virtual_time_ns / 1e9, abs=1e-3)
    assert record.struck[-1].virtual_time_ns <= outcome.qof.flight_time_s * 1e9
    assert all(one.after == one.read_back != one.before for one in record.struck)
    assert replay(outcome, server).answer == "replayed"
