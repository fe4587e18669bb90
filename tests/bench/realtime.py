"""Flights in real time beside flights in virtual time on this machine's own latencies.

``python -m tests.bench.realtime HOST.toml [REALTIME] [LOCKSTEP]``: the platform's file is made by
``zenfi bench kernels --output HOST.toml``. Realtime flights go one at a time.
"""

import json
import sys

from dashboard.campaigns.spec import Run
from deploy.config.definitions import inlined
from services.models.mission import MissionSpec
from services.models.outcome import Outcome
from tests.bench.fly_all import fly_all

FIELDS = ("flight_time_s", "distance_m", "energy_kj", "replans", "min_clearance_m")


def flown(clock: str, flights: int, platform: str, slots: int | None) -> list[Outcome]:
    base = inlined({"platform": platform, "clock": clock})
    runs = [Run(clock, seed, MissionSpec.model_validate({**base, "seed": seed})) for seed in range(flights)]
    outcomes = [one.outcome for one in fly_all(runs, slots) if one.outcome is not None]
    won = sum(outcome.qof.success for outcome in outcomes)
    late = sum(outcome.nodes["sim"].late for outcome in outcomes)
    print(f"{clock}: {won} of {flights} arrived, {late} ticks late", flush=True)
    return outcomes


def main() -> None:
    platform, counts = sys.argv[1], [int(one) for one in sys.argv[2:]]
    realtime, lockstep = (*counts, *(10, 100)[len(counts) :])
    virtual = flown("lockstep", lockstep, platform, None)
    real = flown("realtime", realtime, platform, 1)
    for field in FIELDS:
        spread = [getattr(outcome.qof, field) for outcome in virtual if outcome.qof.success]
        values = sorted(getattr(outcome.qof, field) for outcome in real if outcome.qof.success)
        inside = sum(min(spread) <= value <= max(spread) for value in values)
        line = {"lockstep": [min(spread), max(spread)], "realtime": [values[0], values[-1]], "inside": inside}
        print(field, json.dumps(line))


if __name__ == "__main__":
    main()
