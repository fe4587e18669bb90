"""Outcomes that were proven against flights in full.

`python -m tests.bench.proofs [FAULTS [SEED [KERNEL..]]]`.

For each kernel, in each world, FAULTS faults with calls and instructions of their own are struck with, and
each is flown in full as well. Outcomes must be the same but for what takes time. Ends with how many were
proven by what, and what became of the others.
"""

from __future__ import annotations

import sys
from collections import Counter
from contextlib import closing
from typing import Any

from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from services.kernels import KERNELS
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec
from services.models.outcome import Outcome, repeatable

WORLDS = ("sparse", "dense", "factory", "farm")
SAMPLED = (
    "pid",
    "trajectory",
    "point_cloud",
    "collision_check",
    "octomap",
    "rrt",
    "rrt_connect",
    "rrt_star",
    "prm_star",
)
PLANNERS = ("rrt", "rrt_connect", "rrt_star", "prm_star")
CHANCE = {"compute_s", "messaging_s", "waiting_s", "kernels", "late"}


def comparable(outcome: Outcome) -> dict[str, Any]:
    """All of an outcome that must be the same, proven or flown."""
    told = outcome.model_dump(mode="json", exclude={"wall_s", "proof", "recovered_messages", "injection"})
    for node in told["nodes"].values():
        node.update(dict.fromkeys(CHANCE))
    record = outcome.injection
    told["spec"]["fault"].pop("trigger")
    if record is not None and record.trigger is not None and record.trigger.site is not None:
        site = record.trigger.site.model_copy(update={"way": None})  # one of several
        record = record.model_copy(update={"trigger": record.trigger.model_copy(update={"site": site})})
    return told | {"injection": repeatable(record).model_dump(mode="json") if record is not None else None}


def mission(kernel: str, world: str, seed: int) -> MissionSpec:
    """A mission in which the kernel is called."""
    planner = {"planner": kernel} if kernel in PLANNERS else {}
    return MissionSpec.model_validate({"world": world, "seed": seed, **planner})


def compared(server: ForkServer, kernel: str, world: str, count: int, seed: int) -> tuple[Counter[str], int]:
    """How many faults had what end, and how many outcomes were as flown; tells of each that was not."""
    proving, flying = PairFlyer(server), PairFlyer(server)
    spec = mission(kernel, world, seed)
    faults = [FaultSpec(target=kernel, seed=1000 * seed + number) for number in range(count)]
    ends: Counter[str] = Counter()
    same = 0
    for place, fault in enumerate(faults):
        asked = spec.model_copy(update={"fault": fault})
        proven = proving.fly(asked, ahead=faults[place + 1 :])
        flown = flying.fly(asked)
        ends[proven.proof.by if proven.proof is not None else "flown"] += 1
        first, second = comparable(proven), comparable(flown)
        differ = [name for name in first if first[name] != second[name]]
        same += not differ
        for name in differ:
            print(f"{kernel} {world} {fault.seed}, {proven.proof}, {name}:", flush=True)
            print(f"  proven: {first[name]}\n  flown:  {second[name]}", flush=True)
    ends.update(f"struck {found.result}" for found in proving.proofs.strikes)
    return ends, same


def main() -> None:
    """Compare, kernel by kernel and world by world."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 7
    seed = int(sys.argv[2]) if len(sys.argv) > 2 else 1
    kernels = sys.argv[3:] or [one for one in SAMPLED if one in KERNELS]
    of = same = 0
    with closing(ForkServer()) as server:
        for kernel in kernels:
            for world in WORLDS:
                ends, alike = compared(server, kernel, world, count, seed)
                of, same = of + count, same + alike
                told = ", ".join(f"{name} {times}" for name, times in sorted(ends.items()))
                print(f"{kernel} {world}: {alike} of {count} as flown; {told}", flush=True)
    print(f"{same} of {of} as flown")


if __name__ == "__main__":
    main()
