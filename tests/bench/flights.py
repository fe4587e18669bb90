"""Where a flight's wall time goes, how many fit in a minute, how long an injection pauses.

``python -m tests.bench.flights [FLIGHTS]``: figures are of this machine, as it is loaded now.
"""

import os
import statistics
import sys
import time

import numpy as np

from dashboard.campaigns.scheduler import Finished
from dashboard.campaigns.spec import Run
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec
from tests.bench.fly_all import fly_all


def golden(flights: int) -> list[Run]:
    return [Run("golden", seed, MissionSpec(seed=seed)) for seed in range(flights)]


def injected(flights: int) -> list[Run]:
    targets = ("octomap", "rrt_star", "pid")
    return [
        Run(target, seed, MissionSpec(seed=seed, fault=FaultSpec(target=target, seed=seed)))
        for seed in range(flights)
        for target in targets
    ]


def timed(runs: list[Run], slots: int) -> tuple[list[Finished], float]:
    """The finished runs, and flights per minute once the workers are up."""
    finished, begin = [], 0.0
    for one in fly_all(runs, slots):
        begin = begin or time.monotonic()
        finished.append(one)
    return finished, 60 * (len(finished) - slots) / (time.monotonic() - begin)


def main() -> None:
    flights = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    cpus = len(os.sched_getaffinity(0))
    alone, alone_rate = timed(golden(flights), 1)
    together, rate = timed(golden(flights), cpus)
    outcomes = [one.outcome for one in alone if one.outcome is not None]
    wall = statistics.median(outcome.wall_s for outcome in outcomes)
    flown = statistics.median(outcome.qof.flight_time_s for outcome in outcomes)
    print(f"one golden flight: {wall:.2f} s of wall time for {flown:.1f} s of flight (median of {flights})")
    print(f"flights per minute: {alone_rate:.0f} in one slot, {rate:.0f} in {cpus} slots")
    for stage in outcomes[0].nodes:
        parts = [
            statistics.median(getattr(outcome.nodes[stage], part) for outcome in outcomes)
            for part in ("compute_s", "messaging_s", "waiting_s")
        ]
        print(f"{stage:12} compute {parts[0]:.2f} s, messaging {parts[1]:.2f} s, waiting {parts[2]:.2f} s")
    same = {one.run.index: one.outcome.digest for one in alone if one.outcome is not None}
    repeated = sum(same[one.run.index] == one.outcome.digest for one in together if one.outcome is not None)
    print(f"digests that repeated: {repeated} of {flights}")
    faulty, _ = timed(injected(flights), cpus)
    records = [one.outcome.injection for one in faulty if one.outcome is not None]
    pauses = [record.pause_us for record in records if record is not None and record.status == "injected"]
    print(f"injected: {len(pauses)} of {len(faulty)}")
    p50, p99 = np.percentile(pauses, [50, 99])
    print(f"injection pause: p50 {p50:.0f} us, p99 {p99:.0f} us, longest {max(pauses):.0f} us")


if __name__ == "__main__":
    main()
