"""Pictures of the dashboard's pages, for the docs.

``python -m tests.bench.screenshots DIR [STORE]``: of the campaigns in a store; without one, a tenth of
fig7 is flown for them first, and recorded. A kernel study in the store's folder is shown, if there is one.
"""

import shutil
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

from playwright.sync_api import sync_playwright

from dashboard.campaigns.listing import RunLine, RunQuery
from dashboard.campaigns.presets import scaled
from dashboard.campaigns.spec import Recording, load_campaign
from dashboard.client import Client, RefusedError
from services.bus.mission import MissionSpec
from tests.conftest import wait_until
from tests.dashboard.api.conftest import serving

FLOWN_S = 3600.0
LARGEST_BYTES = 200_000
SHOTS = (
    ("home", "/", 1280, 720, "light"),
    ("new", "/new?preset=own", 1280, 640, "light"),
    ("campaign", "/campaigns/{label}", 1280, 960, "light"),
    ("campaign-dark", "/campaigns/{label}#flights", 1280, 1250, "dark"),
    ("campaign-narrow", "/campaigns/{label}", 390, 844, "light"),
    ("compare", "/compare?first={label}", 1280, 900, "light"),
    ("studies", "/studies", 1280, 900, "light"),
    ("run", "{run}", 1280, 1180, "light"),
    ("run-dark", "{run}#travelled", 1280, 1110, "dark"),
    ("live", "/live", 1280, 1250, "light"),
    ("system", "/system", 1280, 620, "light"),
)
"""File, page, width and height in pixels, theme."""


def main(folder: Path, store: Path | None) -> None:
    chromium = shutil.which("chromium")
    if chromium is None:
        sys.exit("no chromium in PATH: apt-get install chromium")
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        where = store or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        service = stack.enter_context(serving(where))
        client = stack.enter_context(Client(service.address))
        if store is None:
            spec = scaled(load_campaign("fig7"), 0.1)
            made = client.create(spec.model_copy(update={"recording": Recording(keep="all")})).campaign
            wait_until(lambda: client.campaign(made).phase == "done", FLOWN_S)
        label = max(client.campaigns(), key=lambda line: line.done).campaign
        run = most_astray(client, label)
        playwright = stack.enter_context(sync_playwright())
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        stack.callback(browser.close)
        for name, path, width, height, theme in SHOTS:
            page = browser.new_page(
                viewport={"width": width, "height": height},
                color_scheme="dark" if theme == "dark" else "light",
            )
            if name == "live":
                client.fly(MissionSpec(mission="scanning", seed=7))
                wait_until(lambda: len(client.nodes()) > 0, FLOWN_S)
            page.goto(service.address + path.format(label=label, run=run))
            page.wait_for_function("window.did_handshake === true")
            page.get_by_text("Being reckoned").first.wait_for(state="hidden")
            page.wait_for_timeout(3000)
            anchor = path.partition("#")[2]
            if anchor:
                page.evaluate("id => document.getElementById(id).scrollIntoView()", anchor)
                page.wait_for_timeout(500)
            file = folder / f"dashboard-{name}.png"
            page.screenshot(path=file)
            page.close()
            size = file.stat().st_size
            print(f"{file} {size / 1e3:.0f} kB", flush=True)
            if size > LARGEST_BYTES:
                sys.exit(f"{file} has more than {LARGEST_BYTES / 1e3:.0f} kB")


def most_astray(client: Client, label: str) -> str:
    """The page of a run with a recording, whose time of flight differs most from its golden twin's."""
    runs = client.runs(label, RunQuery(limit=1000, phase="done"))

    def astray_s(line: RunLine) -> float:
        flown = line.result
        return abs(flown.flight_time_s - (flown.twin_flight_time_s or flown.flight_time_s)) if flown else 0.0

    chosen = max(runs, key=astray_s)
    try:
        client.recording(label, chosen.id)
    except RefusedError:
        client.record(label, chosen.id)
    return f"/campaigns/{label}/runs/{chosen.id}"


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else None)
