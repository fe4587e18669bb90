"""What the dashboard costs.

``python -m tests.bench.dashboard page [RUNS]`` (10,000): the page of a campaign with so many flown runs,
first and again, until it is drawn in Chromium: wall time, and processor time of the service alone.

``python -m tests.bench.dashboard pushes [RUNS VIEWERS SECONDS]`` (420, 10, 30): processor time of the service
while so many clients look at a campaign, half of it flown, of which a run ends every 0.4 s; nothing flies.

``python -m tests.bench.dashboard viewers [RUNS VIEWERS REPEATS]`` (40, 10, 3): in turns, a campaign that
nobody looks at; one on so many pages elsewhere, that is clients of the lowest priority that speak the pages'
protocol and draw nothing, as people's own machines draw for themselves; and one on so many pages of Chromium
that draw here, at the priority of the flights, for whose processors they then compete. The first ratio is
what the service costs a campaign, the second what it costs to look on the machine that flies. All pages are
open before the first flight. A line each: wall time from first result to last; meanwhile the processor time
of the service's process and of the viewers; what the clients elsewhere were sent.
"""

import json
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import sqlalchemy as sa
from playwright.sync_api import Browser, sync_playwright

from dashboard.campaigns.spec import Arm, CampaignSpec, Run
from dashboard.campaigns.store.schema import RunRow
from dashboard.campaigns.store.store import Store
from services.models.faults.specification import FaultSpec
from services.models.outcome import InjectionRecord, Outcome
from tests.bench.viewers import compare, elsewhere, here, nobody
from tests.conftest import cpu_s
from tests.dashboard.api.conftest import serving
from tests.dashboard.campaigns.store.test_store import outcome

KERNELS = ("point_cloud", "octomap", "collision_check", "rrt_star", "trajectory", "pid")
EVERY_S = 0.4
INSTRUCTIONS = ("add rax, rbx", "vmulsd xmm0, xmm1, xmm2", "mov rdi, rsi", "jne 0x10")


def many(runs: int) -> CampaignSpec:
    """A campaign of so many runs: without faults, and with one in each kernel."""
    arms = (Arm(name="golden"), *(Arm(name=name, fault=FaultSpec(target=name)) for name in KERNELS))
    return CampaignSpec(name="many", runs=runs // len(arms), arms=arms)


def ended(run: int, planned: Run) -> Outcome:
    """How a run may have ended."""
    told = outcome()
    success, flight_time_s = run % 13 != 0, 20 + run * 7919 % 1000 / 100
    record = InjectionRecord(
        status="injected",
        node="control",
        kernel=planned.arm,
        invocation=run,
        instruction=INSTRUCTIONS[run % 4],
        register=("rax", "xmm0", "rdi", "rflags")[run % 4],
        bits=[run % 64],
    )
    return told.model_copy(
        update={
            "qof": told.qof.model_copy(update={"success": success, "flight_time_s": flight_time_s}),
            "injection": record if planned.spec.fault is not None else None,
            "result": "success" if success else "collision",
        }
    )


def fill(folder: Path, runs: int) -> str:
    """The label of a campaign of so many flown runs."""
    with closing(Store(folder)) as store:
        found = store.create(many(runs))
        flown = {run: ended(run, planned) for run, planned in store.planned(found).items()}
        store.write(found, store.states(found), [], flown)
        store.set_desired_state(found, "pause")
        return found.label


@contextmanager
def chromium() -> Iterator[Browser]:
    path = shutil.which("chromium")
    if path is None:
        sys.exit("no chromium in PATH: apt-get install chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


def page(runs: int) -> None:
    with tempfile.TemporaryDirectory() as name:
        label = fill(Path(name), runs)
        with serving(Path(name)) as one, chromium() as browser:
            # What a first page loads of scripts is no matter of how many runs there are.
            shown = browser.new_page()
            shown.goto(one.address)
            shown.wait_for_function("window.did_handshake === true")
            for which in ("first", "again"):
                used, begin = cpu_s(one.process.pid), time.monotonic()
                shown.goto(f"{one.address}/campaigns/{label}")
                shown.locator(".runs tbody tr").nth(20).wait_for()
                shown.locator("canvas").nth(4).wait_for()
                told = {
                    "which": which,
                    "runs": runs,
                    "wall_s": round(time.monotonic() - begin, 2),
                    "service_cpu_s": round(cpu_s(one.process.pid) - used, 2),
                }
                print(json.dumps(told), flush=True)
                shown.get_by_text("Being computed.").wait_for(state="hidden", timeout=300e3)


def pushes(runs: int, count: int, seconds: int) -> None:
    with tempfile.TemporaryDirectory() as name, closing(Store(Path(name))) as store:
        found = store.create(many(runs))
        states, planned = store.states(found), list(store.planned(found).items())
        states.phase = "running"
        store.write(found, states, [], {run: ended(run, one) for run, one in planned[: runs // 2]})
        with serving(Path(name)) as one, store.lock(found):
            with elsewhere(count)(f"{one.address}/campaigns/{found.label}") as told:
                used, begin = cpu_s(one.process.pid), time.monotonic()
                for run, plan in planned[runs // 2 :]:
                    if time.monotonic() > begin + seconds:
                        break
                    store.write(found, states, [], {run: ended(run, plan)})
                    with store.database.writing() as connection:
                        connection.execute(sa.update(RunRow).where(RunRow.id == run).values(phase="done"))
                    time.sleep(EVERY_S)
                wall_s, cpu = time.monotonic() - begin, cpu_s(one.process.pid) - used
            each = {"service_ms_per_viewer_s": round(1e3 * cpu / wall_s / count, 2)}
            print(json.dumps({"wall_s": round(wall_s, 1), "service_cpu_s": round(cpu, 2)} | each | told))


def viewers(runs: int, count: int, repeats: int) -> None:
    with chromium() as browser:
        compare(
            runs, repeats, {"nobody": nobody, "elsewhere": elsewhere(count), "here": here(count, browser)}
        )


if __name__ == "__main__":
    what, *numbers = sys.argv[1:]
    if what == "page":
        page(*map(int, numbers or ["10000"]))
    elif what == "pushes":
        pushes(*map(int, numbers or ["420", "10", "30"]))
    else:
        viewers(*map(int, numbers or ["40", "10", "3"]))
