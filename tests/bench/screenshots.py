"""Pictures of the dashboard's pages, for the docs.

``python -m tests.bench.screenshots DIR [STORE]``: of the campaigns in a store; without one, a tenth of
fig7 is flown for them first, and recorded. A kernel study in the store's folder is shown, if there is one.
For the pages of what goes on, campaigns are begun in the store, and removed again in the end.
"""

import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

from playwright.sync_api import Browser, Page, expect, sync_playwright

from dashboard.api.routes.program_studies import NewProgramStudy
from dashboard.campaigns.presets import scaled
from dashboard.campaigns.spec import RecordingPolicy, load_campaign
from dashboard.campaigns.store.listing import RunLine, RunQuery
from dashboard.client import Client, RequestRefusedError
from services.models.mission import MissionSpec
from tests.dashboard.api.conftest import serving

LOOK_S = 0.3
PATIENCE_MS = 600_000.0
BEFORE_PX = 48
"""Of the part before the one that an address leads to."""
LARGEST_BYTES = 200_000


class Shot(NamedTuple):
    """A picture: its file, the page, its size in pixels, light or dark, what is done before it is taken."""

    name: str
    path: str
    width: int
    height: int
    dark: bool = False
    before: Callable[[Page], None] = lambda _: None


def check(page: Page) -> None:
    """Have the machine examined."""
    page.get_by_role("button", name="Check").click()
    expect(page.get_by_text("Zenoh over Unix sockets")).to_be_visible(timeout=PATIENCE_MS)


STILL = (
    Shot("new", "/new?preset=own", 1280, 640),
    Shot("campaign", "/campaigns/{label}", 1280, 960),
    Shot("campaign-dark", "/campaigns/{label}#flights", 1280, 1250, dark=True),
    Shot("campaign-narrow", "/campaigns/{label}", 390, 844),
    Shot("compare", "/compare?first={label}", 1280, 900),
    Shot("studies", "/studies#fig7", 1280, 900),
    Shot("run", "{run}", 1280, 1180),
    Shot("run-dark", "{run}#travelled", 1280, 1110, dark=True),
)
LIVE = (Shot("live", "/live", 1280, 1450), Shot("system", "/system", 1280, 1720, before=check))
HOME = Shot("home", "/", 1280, 780)
PROGRAMS = (
    Shot("programs", "/programs", 1280, 640),
    Shot("program", "/programs/{study}", 1280, 1250),
)
STRUCK = """
runs = 500

[program]
command = ["gzip", "-c", "/usr/share/common-licenses/GPL-3"]
"""


def main(folder: Path, store: Path | None) -> None:
    chromium = shutil.which("chromium")
    if chromium is None:
        sys.exit("no chromium in PATH: apt-get install chromium")
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        where = store or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        allowed = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        (allowed / "gzip.toml").write_text(STRUCK)
        service = stack.enter_context(serving(where, "--programs", str(allowed)))
        client = stack.enter_context(Client(service.address))
        if store is None:
            spec = scaled(load_campaign("fig7"), 0.1)
            made = client.campaigns.create(
                spec.model_copy(update={"recording": RecordingPolicy(keep="all")})
            ).campaign
            until(lambda: client.campaigns.get(made).phase == "done")
        label = max(client.campaigns.all(), key=lambda line: line.done).campaign
        run = most_astray(client, label)
        playwright = stack.enter_context(sync_playwright())
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        stack.callback(browser.close)
        for shot in STILL:
            take(browser, folder, shot, service.address + shot.path.format(label=label, run=run))
        study = struck(client)
        for shot in PROGRAMS:
            take(browser, folder, shot, service.address + shot.path.format(study=study))
        with at_work(client):
            take(browser, folder, HOME, service.address + HOME.path)
        for shot in LIVE:
            flight = client.flights.create(MissionSpec(mission="scanning", seed=7)).campaign.campaign
            until(lambda: len(client.nodes()) > 0)
            take(browser, folder, shot, service.address + shot.path)
            remove(client, flight)


def struck(client: Client) -> str:
    """A study of a program, done."""
    study = client.program_studies.create(NewProgramStudy(program="gzip")).study
    until(lambda: client.program_studies.get(study).phase == "done")
    return study


def take(browser: Browser, folder: Path, shot: Shot, address: str) -> None:
    """Take a picture of a page."""
    page = browser.new_page(
        viewport={"width": shot.width, "height": shot.height},
        color_scheme="dark" if shot.dark else "light",
    )
    page.goto(address)
    page.wait_for_function("window.did_handshake === true")
    page.get_by_text("Being computed").first.wait_for(state="hidden")
    shot.before(page)
    page.wait_for_timeout(3000)
    anchor = address.partition("#")[2]
    if anchor:
        page.evaluate("id => document.getElementById(id).scrollIntoView()", anchor)
        page.mouse.wheel(0, BEFORE_PX)
    else:
        page.evaluate("scrollTo(0, 0)")
    page.wait_for_timeout(500)
    file = folder / f"dashboard-{shot.name}.png"
    page.screenshot(path=file)
    page.close()
    size_bytes = file.stat().st_size
    print(f"{file} {size_bytes / 1e3:.0f} kB", flush=True)
    if size_bytes > LARGEST_BYTES:
        sys.exit(f"{file} has more than {LARGEST_BYTES / 1e3:.0f} kB")


def until(condition: Callable[[], bool]) -> None:
    """Wait; not so busily that it takes from those who fly."""
    while not condition():
        time.sleep(LOOK_S)


@contextmanager
def at_work(client: Client) -> Iterator[None]:
    """Campaigns of which one was paused, one flies and one waits for its turn, for as long as that."""

    def begin(preset: str, scale: float, flown: int) -> str:
        label = client.campaigns.create(preset=preset, scale=scale).campaign
        until(lambda: client.campaigns.get(label).done >= flown)
        return label

    def phase(label: str, wanted: str) -> None:
        until(lambda: client.campaigns.get(label).phase == wanted)

    paused = begin("table3", 0.1, 12)
    client.campaigns.command(paused, "pause")
    phase(paused, "paused")
    flying = begin("fig9", 1.0, 12)
    waiting = begin("demo", 1.0, 0)
    yield
    for label in (waiting, flying, paused):
        remove(client, label)


def remove(client: Client, label: str) -> None:
    """Take away what was begun for a picture."""
    if client.campaigns.get(label).phase not in ("done", "cancelled"):
        client.campaigns.command(label, "cancel")
        until(lambda: client.campaigns.get(label).phase == "cancelled")

    def gone() -> bool:
        try:
            client.campaigns.delete(label)
        except RequestRefusedError:  # its pilot is about to leave it
            return False
        return True

    until(gone)


def most_astray(client: Client, label: str) -> str:
    """The page of the run whose time of flight differs most from its golden twin's; both are recorded."""
    runs = client.runs.all(label, RunQuery(limit=1000, phase="done"))

    def astray_s(line: RunLine) -> float:
        flown = line.result
        return abs(flown.flight_time_s - (flown.twin_flight_time_s or flown.flight_time_s)) if flown else 0.0

    chosen = max(runs, key=astray_s)
    client.runs.record(label, chosen.id)
    return f"/campaigns/{label}/runs/{chosen.id}"


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else None)
