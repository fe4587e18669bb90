"""The system page in a browser, while something flies."""

import os
import signal

import pytest
from playwright.sync_api import expect

from dashboard.client import Client
from services.models.mission import Limits, MissionSpec
from tests.conftest import wait_until
from tests.dashboard.api.conftest import Serving
from tests.dashboard.web.conftest import Looking
from tests.deploy.mid_flight import jump_to_nowhere


@pytest.mark.soak
def test_nodes_are_shown_and_how_often_they_were_restarted(
    service: Serving, client: Client, looking: Looking
) -> None:
    page = looking.goto(service.address, "/system")
    expect(page.get_by_text("No node is on a bus.")).to_be_visible()
    expect(page.get_by_text("No stack is up.")).to_be_visible()

    short = MissionSpec(mission="scanning", seed=3, limits=Limits(mission_time_s=12))
    flight = client.flights.create(short).campaign.campaign
    wait_until(lambda: sum(node.restarts == 0 for node in client.nodes()) == 4)
    pids = {node.name: node.pid for node in client.nodes()}
    # Virtual time stands still while we look; for 20 s, then the flight is given up.
    os.kill(pids["sim"], signal.SIGSTOP)
    nodes = page.get_by_role("region", name="Nodes")
    planning = nodes.locator("tr", has=page.get_by_text("planning", exact=True))
    expect(nodes.locator("tbody tr")).to_have_count(4)
    expect(planning.locator("td").nth(5)).to_have_text("0")
    pid = pids["planning"]
    expect(planning.locator("td").nth(1)).to_have_text(str(pid))
    expect(page.get_by_role("region", name="Processes of the service")).to_contain_text(flight)

    jump_to_nowhere(pid)
    expect(planning.locator("td").nth(5)).to_have_text("1")
    os.kill(pids["sim"], signal.SIGCONT)
    assert list(client.watch(flight))[-1].data.phase == "done"


def test_versions_and_what_the_machine_allows(service: Serving, looking: Looking) -> None:
    page = looking.goto(service.address, "/system")
    expect(page.locator(".facts")).to_contain_text("eclipse-zenoh")
    page.get_by_role("button", name="Check").click()
    checks = page.get_by_role("region", name="What this machine allows")
    expect(checks).to_contain_text("Zenoh over Unix sockets")
    expect(checks.locator("tbody tr").first).to_contain_text("in order")
