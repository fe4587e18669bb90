"""A campaign under fire, and what scheduling costs.

``python -m tests.bench.campaigns [RUNS SCHEDULER_KILLS WORKER_KILLS]`` (300, 10, 20): flies a campaign
undisturbed in one slot and in all, then again while its scheduler and its workers are killed at seeded
moments, and compares run by run. Figures are of this machine, as it is loaded now.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import closing
from pathlib import Path

from dashboard.campaigns.flight_record import FlightRecord
from dashboard.campaigns.store.store import Store
from services.runtime import rng
from tests.conftest import alive
from tests.dashboard.campaigns.test_durability import done, workers
from tests.dashboard.command import ZENFI

SPEC = {
    "name": "fire",
    "mission": {"limits": {"mission_time_s": 1.0}},
    "limits": {"attempts": 20},
    "worlds": ["sparse", "dense"],
    "arms": [{"name": "golden"}, {"name": "rrt", "mission": {"planner": "rrt"}}],
}


def spec(folder: Path, runs: int, *, whole: bool = False) -> str:
    """Of so many runs; flights last a virtual second unless they are to be ``whole``."""
    path = folder / "fire.json"
    path.write_text(json.dumps({**SPEC, "runs": runs // 4, **({"mission": {}} if whole else {})}))
    return str(path)


def start(store: Path, *arguments: str) -> "subprocess.Popen[bytes]":
    command = [ZENFI, "campaign", *arguments, "--store", str(store)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def undisturbed(store: Path, path: str, slots: int, *arguments: str) -> float:
    """Wall time from the first result to the last, in s."""
    with start(store, "run", path, "--slots", str(slots), *arguments) as command:
        while not done(store) and command.poll() is None:
            time.sleep(0.02)
        begin = time.monotonic()
        assert command.wait() == 0
    return time.monotonic() - begin


def under_fire(store: Path, path: str, runs: int, kills: list[str]) -> None:
    draw = rng.generator(0, "campaign bench")
    moments = sorted(int(moment) for moment in draw.integers(1, runs - 4, len(kills)))
    command = start(store, "run", path)
    for moment, victim in zip(moments, kills, strict=True):
        while done(store) < moment:
            if command.poll() is not None:
                command = start(store, "resume")
            time.sleep(0.05)
        crew = workers(command.pid)
        pid = command.pid if victim == "scheduler" or not crew else int(draw.choice(crew))
        if alive(pid):
            os.kill(pid, signal.SIGKILL)
        if pid == command.pid:
            command.wait()
            command = start(store, "resume")
    assert command.wait() == 0, "the campaign did not end"


def records(store: Path) -> list[FlightRecord]:
    with closing(Store(store)) as opened:
        return list(opened.records(opened.find("1")))


def main() -> None:
    runs, schedulers, crews = [int(word) for word in sys.argv[1:]] or [300, 10, 20]
    cpus = len(os.sched_getaffinity(0))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = spec(folder, runs)
        alone = undisturbed(folder / "alone", path, 1)
        together = undisturbed(folder / "together", path, cpus)
        calm = records(folder / "alone")
        # The clock starts at the first result.
        flown = sum(record.result.wall_s for record in calm[1:] if record.result is not None)
        gain, overhead = alone / together, 100 * (alone / flown - 1)
        print(f"{len(calm)} runs: one slot {alone:.0f} s, {cpus} slots {together:.0f} s, {gain:.2f} times")
        print(f"scheduling and storing in one slot: {overhead:.1f} % of the wall time of flights this short")
        kills = ["scheduler"] * schedulers + ["worker"] * crews
        order = rng.generator(1, "campaign bench").permutation(len(kills))
        under_fire(folder / "fire", path, runs, [kills[index] for index in order])
        fire = records(folder / "fire")
        same = sum(
            a.result is not None
            and b.result is not None
            and (a.cell, a.number, a.result.digest) == (b.cell, b.number, b.result.digest)
            for a, b in zip(calm, fire, strict=True)
        )
        print(f"{schedulers} schedulers and {crews} workers killed: {same} of {len(calm)} runs the same")


if __name__ == "__main__":
    main()
