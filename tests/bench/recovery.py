"""Detectors in flight: what they cost golden flights, what they find, and what recovery is worth.

``python -m tests.bench.recovery golden [SEEDS]``: golden flights with and without each detector, paired.
``python -m tests.bench.recovery struck [FLIGHTS] [SCHEME ...]``: one high bit of a waypoint's position or
velocity or of the command's flipped at source level, flown with and without recovery. *Beyond* are flips
that change the level by more than any step of golden flights; they are judged offline on the same flight.
"""

import statistics
import sys
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np

from dashboard.campaigns.spec import Run
from deploy.bench.detector_series import series
from deploy.mission.flight import FlownMission, fly
from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer, draw_call
from detector.schemes.registry import load_detector, with_models
from detector.series.changes import followed
from detector.series.monitored_states import WATCHED
from detector.series.preprocessing import levels
from detector.series.series import Series
from services.models.detection import DetectorSpec
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec
from services.models.outcome import InjectionRecord, Outcome
from tests.bench.fly_all import fly_all
from tests.detector.stored_lessons import load_lessons

WORLDS = ("sparse", "dense")
TARGETS = ("trajectory.position", "trajectory.velocity", "command.velocity")
BITS = (59, 61, 62, 63)
POINTS = (2, 4, 6)
"""Rows that are soon flown to, whatever becomes of the trajectory."""

SEEDS = 4
"""Of each world, over which struck flights are spread: their golden twins are flown once."""

LESSONS = Path(__file__).parents[1] / "detector" / "lessons" / "gaussian.npz"
"""Of the 100 training flights, for the largest golden changes."""


def golden(seeds: int) -> None:
    print(
        "| world | detector | success | without | time, median ratio | lowest | highest | false alarms"
        " | detection % | thread time % |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    schemes = ("", *with_models())
    runs = [
        Run(
            f"{world} {scheme}",
            seed,
            MissionSpec(
                world=world, seed=seed, detector=DetectorSpec(scheme=scheme, gate="on") if scheme else None
            ),
        )
        for seed in range(seeds)
        for world in WORLDS
        for scheme in schemes
    ]
    flown: dict[tuple[str, int], Outcome] = {}
    for one in fly_all(runs):
        if one.outcome is None:
            print(f"{one.run.arm}, seed {one.run.index}: {one.error}", file=sys.stderr)
        else:
            flown[one.run.arm, one.run.index] = one.outcome
    for world in WORLDS:
        for scheme in schemes[1:]:
            pairs = [
                (flown[f"{world} {scheme}", seed], flown[f"{world} ", seed])
                for seed in range(seeds)
                if (f"{world} {scheme}", seed) in flown and (f"{world} ", seed) in flown
            ]
            print(golden_row(world, scheme, pairs), flush=True)


def golden_row(world: str, scheme: str, pairs: list[tuple[Outcome, Outcome]]) -> str:
    both = [(a.qof, b.qof) for a, b in pairs if a.qof.success and b.qof.success]
    ratios = [a.flight_time_s / b.flight_time_s for a, b in both]
    reports = [a.detection for a, _ in pairs if a.detection is not None]
    spent = [
        a.nodes["detector"].kernels[scheme].cpu_ns / 1e9 / a.qof.flight_time_s
        for a, _ in pairs
        if a.qof.flight_time_s > 0.0
    ]
    return (
        f"| {world} | {scheme} | {sum(a.qof.success for a, _ in pairs)} | "
        f"{sum(b.qof.success for _, b in pairs)}/{len(pairs)} | {statistics.median(ratios):.4f} | "
        f"{min(ratios):.4f} | {max(ratios):.4f} | {sum(len(one.alarms) for one in reports)} in "
        f"{sum(bool(one.alarms) for one in reports)} | "
        f"{100 * max(one.detection_share for one in reports):.4f} | {100 * statistics.mean(spent):.3f} |"
    )


def struck(flights: int, schemes: Iterable[str]) -> None:
    server = ForkServer()
    pairs = PairFlyer(server)
    lessons = load_lessons(LESSONS)
    largest = {name: max(float(np.abs(one[name]).max(initial=0)) for one in lessons) for name in lessons[0]}
    print(
        "| detector | struck | beyond | found in flight | offline | success: golden, struck, with detector"
        " | time over golden, mean: struck, with detector | worst | alarms before the fault |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for scheme in schemes:
        trials = [
            found for number in range(flights) if (found := trial(server, pairs, scheme, number, largest))
        ]
        print(struck_row(scheme, trials), flush=True)
    server.close()


class Trial:
    """One fault: flown golden, struck without recovery, struck with it."""

    def __init__(self, twin: Outcome, free: FlownMission, held: Outcome) -> None:
        self.twin, self.free, self.held = twin, free.outcome, held
        self.series = series(free.outcome.spec, free)
        assert self.free.injection is not None
        self.injection: InjectionRecord = self.free.injection
        self.beyond = False

    @property
    def found(self) -> bool:
        assert self.free.detection is not None
        return any(alarm.true for alarm in self.free.detection.alarms)


def trial(
    server: ForkServer, pairs: PairFlyer, scheme: str, number: int, largest: dict[str, float]
) -> Trial | None:
    world, target = WORLDS[number % 2], TARGETS[number % 3]
    fault = FaultSpec(
        level="source",
        target=target,
        seed=number,
        bit_numbers=(BITS[number // 6 % len(BITS)],),
        point=POINTS[number // 3 % len(POINTS)] if target.startswith("trajectory") else None,
    )
    mission = partial(MissionSpec, world=world, seed=number // 2 % SEEDS)
    watched, idle = DetectorSpec(scheme=scheme), DetectorSpec(scheme=scheme, recovery="off")
    twin = pairs.fly(mission())
    fault = fault.model_copy(update={"trigger": draw_call(fault, twin)})
    free = fly(mission(detector=idle, fault=fault), server, keep_messages=True)
    held = fly(mission(detector=watched, fault=fault), server).outcome
    if free.outcome.injection is None or free.outcome.injection.status != "injected":
        return None
    made = Trial(twin, free, held)
    made.beyond = is_beyond(made.series, made.injection, largest)
    if scheme == "autoencoder":
        made.beyond = made.beyond and tracked(made.series, made.injection)
    if made.beyond and not made.found:
        print(f"missed: {scheme} {number} {made.injection.state} {made.injection.after}", file=sys.stderr)
    return made


def place(flight: Series, injection: InjectionRecord) -> tuple[str, int, int]:
    """Stage, row over all checks, and column of the struck value."""
    stage, checks = injection.node, flight.checks[injection.node]
    row = checks.rows(injection.invocation).start + (1 if stage == "control" else injection.point)
    return stage, row, WATCHED[stage].index(injection.state[0])


def is_beyond(flight: Series, injection: InjectionRecord, largest: dict[str, float]) -> bool:
    stage, row, column = place(flight, injection)
    checks = flight.checks[stage]
    step = 2 if stage == "control" else 1
    if row < step or not followed(stage, checks)[injection.invocation - 1 if stage == "control" else row - 1]:
        return False
    state = injection.state[0]
    change = np.diff(levels(state, checks.values[[row - step, row], column]))[0]
    return bool(abs(change) > largest[state])


def tracked(flight: Series, injection: InjectionRecord) -> bool:
    """Whether control flew towards the struck row."""
    stage, row, column = place(flight, injection)
    if stage == "control":
        return True
    value = flight.checks[stage].values[row, column]
    seen = flight.checks["control"].values[1::2, WATCHED["control"].index(injection.state[0])]
    return bool((seen == value).any())


def offline(scheme: str, one: Trial) -> bool:
    detector = load_detector(scheme)
    found = False
    for stage, checks in one.series.checks.items():
        for index in range(len(checks)):
            if detector.check(stage, checks.values[checks.rows(index)]) is not None:
                detector.reset(stage)
                found |= checks.times_s[index] >= one.injection.virtual_time_ns / 1e9 - 0.04
    return found


def struck_row(scheme: str, trials: list[Trial]) -> str:
    beyond = [one for one in trials if one.beyond]
    excess = [
        [
            outcome.qof.flight_time_s / one.twin.qof.flight_time_s - 1.0
            for one in trials
            if one.twin.qof.success and one.free.qof.success and one.held.qof.success
            for outcome in (one.free if which == "free" else one.held,)
        ]
        for which in ("free", "held")
    ]
    early = sum(not alarm.true for one in trials if one.held.detection for alarm in one.held.detection.alarms)
    return (
        f"| {scheme} | {len(trials)} | {len(beyond)} | {sum(one.found for one in beyond)}"
        f" | {sum(offline(scheme, one) for one in beyond)}"
        f" | {sum(one.twin.qof.success for one in trials)}, {sum(one.free.qof.success for one in trials)}, "
        f"{sum(one.held.qof.success for one in trials)}"
        f" | {', '.join(f'{statistics.mean(part):+.2%}' for part in excess)}"
        f" | {', '.join(f'{max(part):+.1%}' for part in excess)} | {early} |"
    )


def main() -> None:
    kind, *more = sys.argv[1:] or ["golden"]
    count = int(more[0]) if more else 20
    if kind == "golden":
        golden(count)
    else:
        struck(count, more[1:] or with_models())


if __name__ == "__main__":
    main()
