"""What scheduling costs on this machine's slots and on a Dask cluster's.

``python -m tests.bench.executors [RUNS]`` (40): flies the same campaign of whole flights by each executor
in one slot and sets its wall time beside the flights' own, as a ratio within one run. Figures are of this
machine, as it is loaded now.
"""

import os
import sys
import tempfile
from pathlib import Path

from distributed import LocalCluster

from deploy.workers.dask_task import RESOURCE
from tests.bench.campaigns import records, spec, undisturbed


def overhead(store: Path, path: str, *arguments: str) -> tuple[float, list[str]]:
    """Wall time that is no flight's, as a share of the flights'; and the digests of all runs."""
    wall_s = undisturbed(store, path, 1, *arguments)
    results = [record.result for record in records(store) if record.result is not None]
    # The clock starts at the first result.
    return wall_s / sum(result.wall_s for result in results[1:]) - 1, [result.digest for result in results]


def main() -> None:
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 40
    with (
        tempfile.TemporaryDirectory() as name,
        LocalCluster(
            n_workers=1,
            threads_per_worker=1,
            resources={RESOURCE: 1},
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
        ) as cluster,
    ):
        folder = Path(name)
        path = spec(folder, runs, whole=True)
        local, here = overhead(folder / "local", path)
        at = cluster.scheduler_address.replace("tcp", "dask")
        dask, there = overhead(folder / "dask", path, "--executor", at)
    same = sum(one == other for one, other in zip(here, there, strict=True))
    load = " ".join(f"{one:.1f}" for one in os.getloadavg())
    print(f"{len(here)} runs in one slot; load {load}")
    print(
        f"local {100 * local:.1f} %, dask {100 * dask:.1f} % of the flights' wall time; {same} runs the same"
    )


if __name__ == "__main__":
    main()
