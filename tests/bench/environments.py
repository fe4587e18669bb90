"""Golden flights per environment: success, time, distance, energy, wall time.

``python -m tests.bench.environments [SEEDS] [FIELD=JSON ...]``, e.g. ``20 world='"dense"' platform='"tx2"'``.
"""

import json
import statistics
import sys

from dashboard.campaigns.spec import Run
from services.models.mission import MissionSpec
from tests.bench.fly_all import fly_all

ENVIRONMENTS = ("factory", "farm", "sparse", "dense")


def main() -> None:
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    fields = {name: json.loads(value) for name, _, value in (one.partition("=") for one in sys.argv[2:])}
    worlds = [fields.pop("world")] if "world" in fields else ENVIRONMENTS
    print("| environment | success | time s | distance m | energy kJ | power W | replans | wall s | lost |")
    print("|---|---|---|---|---|---|---|---|---|")
    for world in worlds:
        runs = [
            Run(str(world), seed, MissionSpec.model_validate({**fields, "world": world, "seed": seed}))
            for seed in range(seeds)
        ]
        finished = list(fly_all(runs))
        for one in finished:
            if one.error:
                print(f"seed {one.run.index}: {one.error}", file=sys.stderr)
        flown = [one.outcome for one in finished if one.outcome is not None]
        won = [outcome.qof for outcome in flown if outcome.qof.success]
        lost = [f"{outcome.spec.seed} {outcome.result}" for outcome in flown if not outcome.qof.success]
        middle = [
            statistics.mean(getattr(qof, field) for qof in won)
            for field in ("flight_time_s", "distance_m", "energy_kj")
        ]
        watts = statistics.mean(1000 * qof.energy_kj / qof.flight_time_s for qof in won)
        replans = statistics.mean(qof.replans for qof in won)
        wall = statistics.mean(outcome.wall_s for outcome in flown)
        print(
            f"| {world} | {len(won)}/{len(flown)} | {middle[0]:.1f} | {middle[1]:.1f} | {middle[2]:.1f}"
            f" | {watts:.0f} | {replans:.1f} | {wall:.2f} | {', '.join(sorted(lost))} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
