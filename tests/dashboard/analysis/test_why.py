"""A flight with a fault is told in sentences that say what the outcome says, and no more."""

import struct

from dashboard.analysis.why import why
from services.models.detection import AlarmRecord, DetectionReport
from services.models.mission import MissionSpec
from services.models.oracles.harm import HarmEvent
from services.models.outcome import (
    NO_FLIGHT,
    GoldenTwin,
    InjectionRecord,
    NodeReport,
    Outcome,
    Proof,
    TopicReport,
)

FLOWN = NO_FLIGHT.model_copy(update={"success": True, "flight_time_s": 20.0})


def of_double(value: float) -> str:
    return f"{int.from_bytes(struct.pack('<d', value), 'little'):016x}"


WAYPOINT = InjectionRecord(
    status="injected",
    node="planning",
    kernel="",
    invocation=41,
    state=["trajectory.x"],
    width_bits=64,
    element_bits=64,
    bits=[61],
    before=of_double(1.25),
    after=of_double(1.25 * 2.0**-512),
    virtual_time_ns=8_200_000_000,
)

REGISTER = WAYPOINT.model_copy(
    update={
        "node": "control",
        "kernel": "pid",
        "state": [],
        "register_name": "xmm0",
        "instruction": "mulsd xmm0, xmm1",
        "symbol": "_ZN3Pid4stepEd",
        "element_bits": 0,
        "bits": [3, 4],
        "before": "0",
        "after": "18",
    }
)


def flown(record: InjectionRecord | None = WAYPOINT, **fields: object) -> Outcome:
    """A flight that was lost; its golden twin was not."""
    lost = Outcome(
        spec=MissionSpec(),
        result="collision",
        qof=FLOWN.model_copy(update={"success": False, "flight_time_s": 12.3}),
        digest="own",
        wall_s=1.0,
        nodes={},
        topics={
            "trajectory": TopicReport(messages=9, digest="a", diverged_at_s=8.2),
            "command": TopicReport(messages=9, digest="b", diverged_at_s=8.25),
            "odometry": TopicReport(messages=9, digest="c"),
        },
        injection=record,
        golden=GoldenTwin(result="success", qof=FLOWN, digest="twin"),
        harm=[HarmEvent(kind="mission_lost", at_ns=12_300_000_000)],
    )
    return lost.model_copy(update=fields)


def alarm(at_ns: int, *, true: bool) -> AlarmRecord:
    return AlarmRecord(
        stage="planning",
        topic="trajectory",
        state="x",
        row=0,
        score=2.0,
        virtual_time_ns=at_ns,
        action="recomputed",
        true=true,
    )


def test_from_the_bit_to_the_lost_mission() -> None:
    assert why(flown()) == (
        "At 8.200 s bit 61 of trajectory.x in message 41 turned 1.25 into 9.32292591e-155. "
        "Messages left the golden twin's: trajectory 0.000 s later, command 0.050 s later. "
        "The mission ended in collision after 12.30 s; its golden twin in success after 20.00 s: "
        "harm (mission lost from 12.30 s)."
    )


def test_an_instruction_is_told_with_its_call_and_function() -> None:
    told = why(flown(REGISTER))
    place = "2 bits of xmm0 in call 41 of pid (`mulsd xmm0, xmm1` in Pid::step(double))"
    assert told.startswith(f"At 8.200 s {place} turned ")
    assert "turned 0x0000000000000000 = 0 into 0x0000000000000018 = 24." in told


def test_who_noticed_and_what_died() -> None:
    died = {
        "planning": NodeReport(
            result="crash", causes=["SIGSEGV"], restarts=1, guards={"finite": 2, "range": 1}
        )
    }
    report = DetectionReport(
        alarms=[alarm(7_000_000_000, true=False), alarm(8_300_000_000, true=True)],
        checks=9,
        detection_share=0.0,
        recomputation_share=0.0,
        ungated=0,
    )
    watched = MissionSpec.model_validate({"detector": {"scheme": "kinematic"}})
    twin = GoldenTwin(result="success", qof=FLOWN, digest="twin", guards=("range",))
    told = why(flown(nodes=died, detection=report, spec=watched, golden=twin))
    assert "planning died (SIGSEGV), and was started again." in told
    assert "Guards acted that did not in the golden twin: finite." in told
    assert "raised an alarm 0.100 s after the strike about planning's x: recomputed." in told
    missed = report.model_copy(update={"alarms": [alarm(7_000_000_000, true=False)]})
    assert "The detector (kinematic) missed it." in why(flown(detection=missed, spec=watched))


def test_a_flight_that_is_its_twin_is_not_made_more_of() -> None:
    told = why(
        flown(
            result="success",
            qof=FLOWN,
            topics={"command": TopicReport(messages=9, digest="b")},
            harm=[],
            proof=Proof(by="same_memory"),
        )
    )
    assert "Every message is the golden twin's." in told
    assert "The mission ended in success after 20.00 s, +0.00 s beside its golden twin: no harm." in told
    assert told.endswith("That is proven, not flown: after the call, memory as in the golden twin.")


def test_what_did_not_strike_is_said_to_have_not() -> None:
    missed = WAYPOINT.model_copy(update={"status": "not_activated", "reason": "a trajectory without points"})
    told = why(flown(missed))
    assert told.startswith(
        "The fault did not strike (not activated: a trajectory without points). The mission"
    )
    assert why(flown(None)) == ""
    assert "no golden twin" in why(flown(golden=None, harm=None))
