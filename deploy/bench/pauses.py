"""Measures the cost of injections on this machine: pauses, precisions, single steps.

All processes of the table fly, the detector too, which is no stage but stands in a pause like one.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable

import numpy as np

from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from injector.tracing.tracees import TraceeGroup
from services.models.base import Strict
from services.models.detection import DetectorSpec
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec
from services.models.outcome import InjectionRecord

TARGETS = ("point_cloud", "octomap", "collision_check", "rrt_star", "trajectory", "pid")
SCHEME = "gaussian"
STEPS = 5000


class InjectionFigures(Strict):
    """Figures of one bench. A pause is from the first stop to the last resume of all threads.

    ``nodes`` announce themselves; all stand in a pause but one, the injector.
    """

    nodes: int
    flights: int
    injections: int
    statuses: dict[str, int]
    precisions: dict[str, int]
    threads_stopped: int
    pause_p50_us: float
    pause_p99_us: float
    pause_longest_us: float
    steps_per_s: float
    flight_wall_s: float


def measure_injections(
    server: ForkServer, flights: int, flown: Callable[[], object] = lambda: None
) -> InjectionFigures:
    """Fly injected missions, every kernel in turn; ``flown`` is called after each.

    :raises InfrastructureError: if the infrastructure failed.
    """
    pairs = PairFlyer(server)
    records: list[InjectionRecord] = []
    walls = []
    nodes = set()
    for number in range(flights):
        fault = FaultSpec(target=TARGETS[number % len(TARGETS)], seed=number)
        spec = MissionSpec(seed=number // len(TARGETS), fault=fault, detector=DetectorSpec(scheme=SCHEME))
        outcome = pairs.fly(spec)
        nodes.add(len(outcome.nodes) + 1)
        walls.append(outcome.wall_s)
        if outcome.injection is not None:
            records.append(outcome.injection)
        flown()
    struck = [one for one in records if one.status == "injected"]
    pauses = [one.pause_us for one in struck] or [0.0]
    p50, p99 = (float(figure) for figure in np.percentile(pauses, [50, 99]))
    return InjectionFigures(
        nodes=min(nodes),
        flights=flights,
        injections=len(struck),
        statuses=dict(sorted(Counter(one.status for one in records).items())),
        precisions=dict(sorted(Counter(one.precision for one in struck).items())),
        threads_stopped=max((one.threads_stopped for one in struck), default=0),
        pause_p50_us=p50,
        pause_p99_us=p99,
        pause_longest_us=max(pauses),
        steps_per_s=steps_per_s(),
        flight_wall_s=float(np.median(walls)),
    )


def steps_per_s() -> float:
    """How fast a thread is stepped through its instructions."""
    child = subprocess.Popen([sys.executable, "-I", "-S", "-c", "while True: pass"])
    try:
        with TraceeGroup() as tracees:
            tracees.seize([child.pid])
            tracees.stop_all()
            begin = time.monotonic()
            addresses = tracees.trace(tracees.threads[child.pid], STEPS)
            return len(addresses) / (time.monotonic() - begin)
    finally:
        child.kill()
        child.wait()
