"""Campaigns that were not flown: strikes drawn from probabilities that are known, and a budget for them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from dashboard.campaigns.events import Begin, Leased, RunStarted
from dashboard.campaigns.events import Flown as RunFlown
from dashboard.campaigns.flight_record import FlightRecord, Result
from dashboard.campaigns.spec import Arm, CampaignSpec, Condition, Run, runs
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.campaigns.store.store import Store
from dashboard.evidence.budget import Element, Stated, UpsetBudget
from dashboard.evidence.counts import Flown
from services.models.detection import DetectionReport
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec
from services.models.oracles.harm import HarmEvent
from services.models.outcome import NO_FLIGHT, GoldenTwin, InjectionRecord, Outcome

PID, WAY = FaultSpec(target="pid"), FaultSpec(level="source", target="trajectory.position", field="exponent")
MOTOR = FaultSpec(level="actuator", target="motor2", model="wrong", size=0.5, from_s=8.0)

BARE = MissionSpec(pilot="baseline")
GUARD = {"guards": ["clip", "finite", "restart"]}
DETECTOR = {"detector": {"scheme": "gaussian"}}

SPEC = CampaignSpec(
    name="options",
    runs=200,
    mission=BARE,
    arms=(Arm(name="bare"), Arm(name="finite", mission=GUARD), Arm(name="gaussian", mission=DETECTOR)),
    faults=(Condition(name="pid", fault=PID), Condition(name="way", fault=WAY)),
)


def exactly(value: float) -> Stated:
    return Stated(value=value, source="by hand")


def element(name: str, fit: float = 100.0, **names: str) -> Element:
    cell = {"arm": "bare", "fault": name} | names
    return Element(name=name, fit=exactly(fit), flux=exactly(2.0), share=exactly(0.5), **cell)


BUDGET = UpsetBudget(name="by hand", draws=2_000, elements=(element("pid"), element("way", 40.0)))


@dataclass(frozen=True)
class Truth:
    """What is true: P(harm | strike) bare by target, and by (protection, target) P(averts), and P(adds harm).

    ``slower`` is the part by which a protection makes flights longer; its energy grows twice as much.
    """

    harm: Mapping[str, float]
    averts: Mapping[tuple[str, str], float]
    adds: Mapping[tuple[str, str], float] = field(default_factory=dict)
    slower: Mapping[str, float] = field(default_factory=dict)
    strikes: float = 1.0


TRUTH = Truth(
    harm={"pid": 0.3, "trajectory.position": 0.5},
    averts={
        ("finite", "pid"): 0.2,
        ("finite", "trajectory.position"): 0.7,
        ("gaussian", "pid"): 0.6,
        ("gaussian", "trajectory.position"): 0.4,
    },
    slower={"finite": 0.01, "gaussian": 0.04},
    strikes=0.9,
)


def protections(mission: MissionSpec) -> list[str]:
    """What a mission has on, by the names of the arms above."""
    return ["finite"] * ("finite" in mission.active_guards) + ["gaussian"] * (mission.detector is not None)


def outcome(run: Run, truth: Truth) -> Outcome:
    """The outcome of a run, drawn: the same strike meets the same luck with each protection."""
    on = protections(run.spec)
    times = 20.0 + run.spec.seed % 7
    longer = 1 + sum(truth.slower.get(name, 0.0) for name in on)
    hotter = 1 + 2 * sum(truth.slower.get(name, 0.0) for name in on)
    qof = NO_FLIGHT.model_copy(
        update={"success": True, "flight_time_s": times * longer, "energy_kj": 10.0 * hotter}
    )
    twin = GoldenTwin(result="success", qof=qof, digest="twin")
    fault = run.spec.fault
    assert fault is not None
    luck = np.random.default_rng([run.spec.seed, fault.seed, len(fault.target)])
    struck, harms = luck.random() < truth.strikes, luck.random() < truth.harm[fault.target]
    for name in ("finite", "gaussian"):
        averts, adds = luck.random(2)
        if name in on and not harms:
            harms = adds < truth.adds.get((name, fault.target), 0.0)
        elif name in on:
            harms = averts >= truth.averts.get((name, fault.target), 0.0)
    harmed = struck and harms
    return Outcome(
        spec=run.spec,
        result="collision" if harmed else "success",
        qof=qof.model_copy(update={"success": not harmed}),
        digest="own" if harmed else "twin",
        wall_s=0.0,
        nodes={},
        topics={},
        injection=InjectionRecord(
            status="injected" if struck else "not_reached", node="control", kernel="pid", invocation=1
        ),
        detection=DetectionReport(
            alarms=[], checks=1, detection_share=0.015625, recomputation_share=0.0, ungated=0
        )
        if "gaussian" in on
        else None,
        golden=twin,
        harm=[HarmEvent(kind="mission_lost", at_ns=1)] if harmed else [],
    )


def flown(spec: CampaignSpec, truth: Truth = TRUTH, number: int = 1) -> Flown:
    """A campaign and its runs, drawn."""
    planned = list(runs(spec))
    return CampaignEntry(number, spec, "done", "", ""), [
        FlightRecord(run.cell, run.index, run.spec.seed, "done", 1, "", Result.of(outcome(run, truth)), place)
        for place, run in enumerate(planned)
    ]


def stored(store: Store, spec: CampaignSpec, truth: Truth = TRUTH) -> CampaignEntry:
    """A campaign in a store with the outcomes of all its runs, drawn."""
    campaign = store.create(spec)
    states, planned = store.states(campaign), store.planned(campaign)
    states.handle(Begin())
    for number in planned:
        for event in (Leased("l", (number,), 9.0), RunStarted("l", number), RunFlown("l", number)):
            states.handle(event)
    store.write(
        campaign, states, list(planned), {number: outcome(run, truth) for number, run in planned.items()}
    )
    return store.find(campaign.label)


def changed(spec: CampaignSpec, arms: Sequence[Arm], **fields: object) -> CampaignSpec:
    """A campaign with other arms."""
    return CampaignSpec.model_validate(spec.model_dump(exclude_unset=True) | {"arms": tuple(arms)} | fields)
