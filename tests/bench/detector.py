"""What detection costs: microseconds a check, and the paper's ratio, detection time over mission time.

``python -m tests.bench.detector [FLIGHTS]``: checks of golden Dense flights, each flight judged ROUNDS times
and the quickest taken, as the machine is shared. Recomputation is not in it.
"""

import sys
import time

from deploy.bench.detector_series import record
from deploy.mission.fork_server import ForkServer
from detector.schemes.base import Floats, Scheme
from detector.schemes.registry import load_detector, with_models
from detector.series.series import Series
from services.models.mission import MissionSpec

ROUNDS = 25


def requests(flight: Series, stage: str) -> list[Floats]:
    checks = flight.checks[stage]
    return [checks.values[checks.rows(index)].copy() for index in range(len(checks))]


def spent_s(scheme: Scheme, stage: str, asked: list[Floats]) -> float:
    check = scheme.check
    begin = time.perf_counter()
    for values in asked:
        check(stage, values)
    return time.perf_counter() - begin


def main() -> None:
    flights = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    server = ForkServer()
    recorded = [record(MissionSpec(world="dense", seed=seed), server) for seed in range(flights)]
    server.close()
    mission_s = sum(flight.about["time_s"] for flight in recorded)
    print("| detector | perception us | planning us | control us | ms a flight | % of mission time |")
    print("|---|---|---|---|---|---|")
    for name in with_models():
        total, cells = 0.0, []
        for stage in ("perception", "planning", "control"):
            asked = [requests(flight, stage) for flight in recorded]
            best = sum(min(spent_s(load_detector(name), stage, one) for _ in range(ROUNDS)) for one in asked)
            total += best
            cells.append(f"{1e6 * best / sum(map(len, asked)):.2f}")
        print(
            f"| {name} | {' | '.join(cells)} | {1e3 * total / flights:.2f} | {100 * total / mission_s:.5f} |"
        )


if __name__ == "__main__":
    main()
