"""What detectors miss: how far a flip that raises no alarm moves the flight.

``python -m tests.bench.missed [FLIGHTS] [SCHEME ...]``: one sign or exponent bit, drawn, of one value of each
monitored state in turn, flipped at source level in Sparse and Dense; detectors watch, and recover nothing. Of
the flights without a true alarm: how they end, and how far they lead from their golden twins.
"""

import statistics
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing

import numpy as np

from deploy.mission.flight import FlownMission, fly
from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import draw_call
from deploy.recording.flight_status import series
from detector.schemes.registry import with_models
from services.bus.horizon import Stamped
from services.models.detection import DetectorSpec
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec

WORLDS = ("sparse", "dense")
TARGETS = (
    "collision_check.time_to_collision",
    "trajectory.position",
    "trajectory.velocity",
    "trajectory.acceleration",
    "command.velocity",
    "command.yaw_rate",
)
SEEDS = 4
"""Of each world, over which flights are spread: their golden twins are flown once."""

EXPONENT_AND_SIGN = tuple(range(52, 64))
Messages = Mapping[str, Sequence[Stamped]]


def main(flights: int, schemes: Iterable[str]) -> None:
    print("| detector | injected | missed | golden, missed succeed | time over golden | farthest from it m |")
    print("|---|---|---|---|---|---|")
    twins: dict[tuple[str, int], FlownMission] = {}
    with closing(ForkServer()) as server:
        for scheme in schemes:
            pairs = [one for number in range(flights) if (one := struck(server, twins, scheme, number))]
            print(row(scheme, pairs), flush=True)


def struck(
    server: ForkServer, twins: dict[tuple[str, int], FlownMission], scheme: str, number: int
) -> tuple[FlownMission, FlownMission] | None:
    """A golden flight and the same with a fault; None if that was never injected."""
    bit = EXPONENT_AND_SIGN[number // len(TARGETS) % len(EXPONENT_AND_SIGN)]
    fault = FaultSpec(level="source", target=TARGETS[number % len(TARGETS)], seed=number, bit_numbers=(bit,))
    world, seed = WORLDS[number % 2], number // 2 % SEEDS
    spec = MissionSpec(world=world, seed=seed)
    if (world, seed) not in twins:
        twins[world, seed] = fly(spec, server, keep_messages=True)
    twin = twins[world, seed]
    fault = fault.model_copy(update={"trigger": draw_call(fault, twin.outcome)})
    watched = DetectorSpec(scheme=scheme, recovery="off")
    flown = fly(spec.model_copy(update={"fault": fault, "detector": watched}), server, keep_messages=True)
    injection = flown.outcome.injection
    return (twin, flown) if injection is not None and injection.status == "injected" else None


def row(scheme: str, pairs: list[tuple[FlownMission, FlownMission]]) -> str:
    missed = [(twin, flown) for twin, flown in pairs if not is_found(flown)]
    both = [
        flown.outcome.qof.flight_time_s / twin.outcome.qof.flight_time_s - 1.0
        for twin, flown in missed
        if twin.outcome.qof.success and flown.outcome.qof.success
    ]
    strayed = [distance_m(twin.messages or {}, flown.messages or {}) for twin, flown in missed]
    return (
        f"| {scheme} | {len(pairs)} | {len(missed)} "
        f"| {sum(twin.outcome.qof.success for twin, _ in missed)}, "
        f"{sum(flown.outcome.qof.success for _, flown in missed)} "
        f"| mean {statistics.mean(both):+.2%}, median {statistics.median(both):+.2%}, "
        f"{min(both):+.1%} to {max(both):+.1%} "
        f"| median {statistics.median(strayed):.2f}, 95 % {np.quantile(strayed, 0.95):.2f}, "
        f"most {max(strayed):.2f} |"
    )


def is_found(flight: FlownMission) -> bool:
    assert flight.outcome.detection is not None
    return any(alarm.true for alarm in flight.outcome.detection.alarms)


def distance_m(golden: Messages, struck: Messages) -> float:
    """The farthest that one path leads from the other, whenever."""
    paths = [np.array([one.position_m for one in series(messages)]) for messages in (golden, struck)]
    apart = np.linalg.norm(paths[1][:, None] - paths[0][None], axis=2)
    return float(apart.min(axis=1).max())


if __name__ == "__main__":
    count, *names = sys.argv[1:] or ["144"]
    main(int(count), names or with_models())
