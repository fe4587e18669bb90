"""What recording all topics costs.

``python -m tests.bench.recording [FLIGHTS]`` (20): each seed flown in turns without and with a recording,
default profile; ratios of wall time of the pairs, processor time of the supervising process, which records,
and sizes.
"""

import statistics
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from services.models.mission import MissionSpec


def timed(server: ForkServer, seed: int, path: Path | None) -> tuple[float, float, str]:
    """Wall and processor time of one flight, and its digest."""
    pairs = PairFlyer(server)  # without memory
    wall, cpu = time.monotonic(), time.process_time()
    outcome = pairs.fly(MissionSpec(seed=seed), path)
    return time.monotonic() - wall, time.process_time() - cpu, outcome.digest


def main() -> None:
    flights = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    server = ForkServer()
    walls, cpus, shares, sizes, same = [], [], [], [], 0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flight.mcap"
        timed(server, 0, path)
        for seed in range(flights):
            order = (None, path) if seed % 2 else (path, None)
            found = {place: timed(server, seed, place) for place in order}
            (wall, cpu, digest), (recorded_wall, recorded_cpu, recorded) = found[None], found[path]
            walls.append(recorded_wall / wall)
            cpus.append(recorded_cpu / cpu)
            shares.append((recorded_cpu - cpu) / wall)
            sizes.append(path.stat().st_size / 1e6)
            same += digest == recorded
    server.close()
    low, median, high = np.percentile(walls, [25, 50, 75])
    print(f"wall time with / without recording: median {median:.3f}, quartiles {low:.3f} and {high:.3f}")
    print(f"processor time of the supervising process: ratio {statistics.median(cpus):.2f},")
    print(f"  what is added is {statistics.median(shares):.1%} of a flight's wall time")
    print(f"size: median {statistics.median(sizes):.2f} MB, largest {max(sizes):.2f} MB")
    print(f"digests that recording did not change: {same} of {flights}")


if __name__ == "__main__":
    main()
