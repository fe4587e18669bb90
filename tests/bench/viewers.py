"""A campaign that people look at, beside one that nobody does; ``tests.bench.dashboard`` has the command."""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from pathlib import Path

from playwright.sync_api import Browser

from dashboard.campaigns.spec import Arm, CampaignSpec
from dashboard.campaigns.store.store import Store
from dashboard.client import Client
from services.models.mission import Limits, MissionSpec
from tests.conftest import cpu_s, descendants
from tests.dashboard.api.conftest import Serving, serving

Told = dict[str, float]
Looking = Callable[[str], AbstractContextManager[Told]]
"""People at an address, settled down when it is entered; what is told of them is complete when it is left."""


@contextmanager
def nobody(_address: str) -> Iterator[Told]:
    """A page that is not looked at."""
    yield {}


def elsewhere(count: int) -> Looking:
    """People at machines of their own."""

    @contextmanager
    def looking(address: str) -> Iterator[Told]:
        told: Told = {}
        command = [sys.executable, "-m", "tests.bench.page_clients", address, str(count)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as clients:
            assert clients.stdin is not None
            assert clients.stdout is not None
            assert clients.stdout.readline() == "ready\n"
            yield told
            clients.stdin.close()
            told.update(json.loads(clients.stdout.readline()))

    return looking


def here(count: int, browser: Browser) -> Looking:
    """People whose browsers draw on the machine that flies."""

    @contextmanager
    def looking(address: str) -> Iterator[Told]:
        context = browser.new_context()
        for _ in range(count):
            page = context.new_page()
            page.goto(address)
            page.locator("canvas").nth(4).wait_for()
        yield {}
        context.close()

    return looking


def flown(one: Serving, folder: Path, runs: int, looking: Looking) -> Told:
    """A campaign from its first result to its last: wall time, and the processor time of who had any."""
    spec = CampaignSpec(
        name="watched",
        runs=runs,
        mission=MissionSpec(limits=Limits(mission_time_s=3)),
        arms=(Arm(name="golden"),),
    )
    with closing(Store(folder)) as store:
        label = store.create(spec).label
    seen: list[tuple[float, ...]] = []
    with Client(one.address) as client, looking(f"{one.address}/campaigns/{label}") as told:
        client.campaigns.command(label, "resume")
        ended = 0
        for event in client.watch(label):
            if event.kind == "run":
                ended += 1
                if ended in (1, runs):
                    seen.append((time.monotonic(), *_used(one)))
    spent = (round(last - first, 2) for first, last in zip(*seen, strict=True))
    names = ("wall_s", "service_cpu_s", "viewers_cpu_s")
    return dict(zip(names, spent, strict=True)) | told


def _used(one: Serving) -> tuple[float, float]:
    """Processor time of the service's own process, and of whatever else this process has started."""
    flying = descendants(one.process.pid)
    others = descendants(os.getpid()).keys() - flying.keys() - {one.process.pid}
    return cpu_s(one.process.pid), sum(map(cpu_s, others))


def compare(runs: int, repeats: int, ways: dict[str, Looking]) -> None:
    """Each way in turns, a line each; then the ratios of the medians to those of the first way."""
    walls: dict[str, list[float]] = {name: [] for name in ways}
    with tempfile.TemporaryDirectory() as name, serving(Path(name)) as one:
        flown(one, Path(name), 4, nobody)
        for _ in range(repeats):
            for way, looking in ways.items():
                told = flown(one, Path(name), runs, looking)
                walls[way].append(told["wall_s"])
                print(json.dumps({"viewers": way} | told), flush=True)
            alone, *_ = (statistics.median(times) for times in walls.values())
            ratios = {way: round(statistics.median(times) / alone, 3) for way, times in walls.items()}
            print(json.dumps({"ratios": ratios}), flush=True)
