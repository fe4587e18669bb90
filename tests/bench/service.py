"""What the service costs.

``python -m tests.bench.service pages [RUNS]`` (10,000): a campaign with so many flown runs; median time of a
page of 100 runs over HTTP, per order and filter, first page and one in the middle.

``python -m tests.bench.service streams [RUNS CLIENTS REPEATS]`` (40, 10, 3): a campaign without clients of
streams and with so many, one of which never reads, in turns; the ratio of their times from first result to
last.

``python -m tests.bench.service large [RUNS]`` (100,000): with so many flown runs, processor time of the
service for pages and tables, and by how much its memory grows while it exports them.
"""

import json
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, closing
from pathlib import Path

import httpx

from dashboard.campaigns.spec import Arm, CampaignSpec
from dashboard.campaigns.store.store import Store
from dashboard.client import Client
from services.models.mission import Limits, MissionSpec
from services.system.process_stat import process_stat
from tests.dashboard.api.conftest import Serving, serving
from tests.dashboard.campaigns.store.test_store import outcome

QUERIES = (
    "",
    "descending=true",
    "sort=energy_kj",
    "sort=flight_time_s&descending=true",
    "phase=done&arm=b",
    "result=timeout&sort=seed",
)


def fill(folder: Path, runs: int) -> None:
    arms = (Arm(name="a"), Arm(name="b", mission={"planner": "rrt"}))
    spec = CampaignSpec(name="many", runs=runs // 2, arms=arms)
    with closing(Store(folder)) as store:
        store.create(spec)  # another campaign's rows before ours
        found = store.create(spec)
        states = store.states(found)
        told = outcome()
        flown = {
            run: told.model_copy(
                update={"qof": told.qof.model_copy(update={"energy_kj": (run * 7919) % 1000})}
            )
            for run in states.runs
        }
        store.write(found, states, [], flown)
        store.set_desired_state(found, "pause")


def pages(runs: int) -> None:
    with tempfile.TemporaryDirectory() as name:
        fill(Path(name), runs)
        with serving(Path(name)) as one, httpx.Client(base_url=one.address) as client:
            for query in QUERIES:
                path = f"/api/v1/campaigns/2/runs?limit=100&{query}"
                middle = deep(client, path, runs // 200)
                for label, asked in (("first", path), ("middle", middle)):
                    times = [timed(client, asked) for _ in range(30)]
                    told = {
                        "query": query,
                        "page": label,
                        "median_ms": round(1e3 * statistics.median(times), 1),
                    }
                    print(json.dumps(told), flush=True)


def large(runs: int) -> None:
    with tempfile.TemporaryDirectory() as name:
        fill(Path(name), runs)
        with serving(Path(name)) as one, httpx.Client(base_url=one.address, timeout=600) as client:
            campaign, pid = "/api/v1/campaigns/2", one.process.pid
            client.get("/api/v1/campaigns").raise_for_status()
            reading = {query: f"{campaign}/runs?limit=100&{query}" for query in QUERIES}
            reading |= {what: f"{campaign}/{what}" for what in ("table", "comparison?against=a")}
            reading |= {"campaigns": "/api/v1/campaigns", "campaign": campaign, "metrics": "/metrics"}
            reading |= {form: f"{campaign}/export?format={form}" for form in ("csv", "parquet")}
            for what, path in reading.items():
                client.get(path).raise_for_status()  # what is loaded the first time
                before, peak = process_stat(pid).cpu_s, _reset_peak(pid)
                with client.stream("GET", path) as answer:
                    size = sum(map(len, answer.iter_bytes()))
                cpu_ms = round(1e3 * (process_stat(pid).cpu_s - before))
                grown = round(_peak_mb(pid) - peak, 1)
                print(
                    json.dumps({"what": what, "cpu_ms": cpu_ms, "bytes": size, "grown_mb": grown}), flush=True
                )


def _reset_peak(pid: int) -> float:
    Path(f"/proc/{pid}/clear_refs").write_text("5")
    return _peak_mb(pid)


def _peak_mb(pid: int) -> float:
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.partition("VmHWM:")[2].split(maxsplit=1)[0]) / 1024


def deep(client: httpx.Client, path: str, pages_on: int) -> str:
    asked = path
    for _ in range(pages_on):
        after = client.get(asked).json()["next"]
        if after is None:
            break
        asked = f"{path}&after={after}"
    return asked


def timed(client: httpx.Client, path: str) -> float:
    begin = time.monotonic()
    client.get(path).raise_for_status()
    return time.monotonic() - begin


def flown_in(one: Serving, runs: int, clients: int) -> float:
    """Wall time of a campaign from its first result to its last, in s."""
    spec = CampaignSpec(
        name="streamed",
        runs=runs,
        mission=MissionSpec(limits=Limits(mission_time_s=3)),
        arms=(Arm(name="golden"),),
    )
    events = f"{one.address}/api/v1/events"
    with ExitStack() as stack:
        for _ in range(clients - 1):
            watching = ["curl", "--silent", "--no-buffer", events]
            reader = stack.enter_context(subprocess.Popen(watching, stdout=subprocess.DEVNULL))
            stack.callback(reader.terminate)
        if clients:
            host, port = one.address.removeprefix("http://").split(":")
            deaf = stack.enter_context(socket.create_connection((host, int(port))))
            deaf.sendall(b"GET /api/v1/events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        with Client(one.address) as client:
            label = client.campaigns.create(spec).campaign
            seen = [time.monotonic() for event in client.watch(label) if event.kind == "run"]
    return seen[-1] - seen[0]


def streams(runs: int, clients: int, repeats: int) -> None:
    with tempfile.TemporaryDirectory() as name, serving(Path(name)) as one:
        flown_in(one, 4, 0)
        alone, watched = [], []
        for _ in range(repeats):
            alone.append(flown_in(one, runs, 0))
            watched.append(flown_in(one, runs, clients))
            ratio = statistics.median(watched) / statistics.median(alone)
            print(json.dumps({"alone_s": alone, "watched_s": watched, "ratio": round(ratio, 3)}), flush=True)
        metrics = httpx.get(f"{one.address}/metrics").text.splitlines()
        print("\n".join(line for line in metrics if line.startswith("zenfi_events")))


if __name__ == "__main__":
    what, *numbers = sys.argv[1:]
    if what == "pages":
        pages(*map(int, numbers or ["10000"]))
    elif what == "large":
        large(*map(int, numbers or ["100000"]))
    else:
        streams(*map(int, numbers or ["40", "10", "3"]))
