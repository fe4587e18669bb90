"""Whether a service stays as it is, flight after flight.

``python -m tests.bench.service_soak [FLIGHTS CAMPAIGN]`` (2,000, 50): one service flies that many short
struck flights in campaigns of that size. After each campaign: memory (RSS, PSS, what is not shared),
descriptors and threads of the service, how many processes it has left, and files in its folder for temporary
ones; while the campaign flies, how many processes there are at most. Then the slope of each over flights, by
least squares without the first fifth, with twice its standard error: what is within that is noise.
"""

import json
import os
import signal
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

from scipy import stats

from dashboard.campaigns.spec import CampaignSpec
from dashboard.client import Client
from services.system.process_stat import process_stat
from tests.conftest import PATIENCE_S, descendants, wait_until
from tests.dashboard.api.conftest import serving

WARM_UP = 0.2
"""Share of the samples that is left out: caches fill, modules are imported."""


@dataclass(frozen=True)
class Sample:
    """The service between two campaigns; ``flying`` is the largest number of its processes before."""

    flights: int
    rss_mb: float
    pss_mb: float
    private_mb: float
    descriptors: int
    threads: int
    left: int
    temporary: int
    flying: int


def specification(number: int, flights: int) -> CampaignSpec:
    """A campaign of so many flights, one golden among them."""
    fault = {"level": "source", "target": "trajectory.vx", "seed": number * flights}
    arms = [{"name": "golden"}, {"name": "source", "fault": fault}]
    mission = {"limits": {"mission_time_s": 0.6}}
    fields = {"name": "soak", "runs": flights - 1, "seeds": 1, "mission": mission, "arms": arms}
    return CampaignSpec.model_validate(fields)


def sample(pid: int, flights: int, missions: Path, flying: int) -> Sample:
    proc = Path(f"/proc/{pid}")
    rollup = (proc / "smaps_rollup").read_text().splitlines()[1:]
    mb = {line.split()[0]: int(line.split()[1]) / 1024 for line in rollup}
    return Sample(
        flights,
        round(process_stat(pid).memory_bytes / 1e6, 2),
        round(mb["Pss:"], 2),
        round(mb["Private_Clean:"] + mb["Private_Dirty:"], 2),
        len(list((proc / "fd").iterdir())),
        len(list((proc / "task").iterdir())),
        len(descendants(pid)),
        len(list(missions.iterdir())),
        flying,
    )


def fly(client: Client, pid: int, spec: CampaignSpec) -> int:
    """Have a campaign flown; the largest number of processes meanwhile."""
    label, most = client.campaigns.create(spec).campaign, 0
    for event in client.watch(label):
        most = max(most, len(descendants(pid)))
        if event.kind == "campaign" and event.data.phase in ("failed", "cancelled", "paused"):
            raise RuntimeError(f"{label} is {event.data.phase}: {event.data.reason}")
    return most


def slopes(samples: list[Sample]) -> list[str]:
    """A line for each figure: at the beginning, at the end, and how it changes in 1,000 flights."""
    kept = samples[int(len(samples) * WARM_UP) :]
    lines = [
        "| figure | first | last | per 1,000 flights | noise (2 standard errors) |",
        "|---|---|---|---|---|",
    ]
    flights = [one.flights for one in kept]
    for name in list(asdict(kept[0]))[1:]:
        values = [float(getattr(one, name)) for one in kept]
        fitted = stats.linregress(flights, values)
        slope, noise = 1000 * fitted.slope, 2000 * fitted.stderr
        lines.append(f"| {name} | {values[0]:g} | {values[-1]:g} | {slope:+.2f} | {noise:.2f} |")
    return lines


def main() -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    wanted, size = [int(word) for word in sys.argv[1:]] or [2000, 50]
    samples: list[Sample] = []
    with tempfile.TemporaryDirectory(prefix="zenfi-soak-") as name:
        missions = Path(name) / "tmp"
        missions.mkdir()
        os.environ["TMPDIR"] = str(missions)
        with serving(Path(name) / "store") as one, Client(one.address) as client:
            try:
                for number in range(max(3, wanted // size)):
                    flying = fly(client, one.process.pid, specification(number, size))
                    wait_until(lambda: not descendants(one.process.pid), PATIENCE_S)
                    flown = (number + 1) * size
                    samples.append(sample(one.process.pid, flown, missions, flying))
                    print(json.dumps(asdict(samples[-1])), flush=True)
            finally:
                if len(samples) > 2:  # interrupted, too
                    print("\n".join(slopes(samples)))


if __name__ == "__main__":
    main()
