"""Flights watched in a browser while they fly, and struck by hand."""

import re
from collections.abc import Iterator

import httpx
import pytest
from playwright.sync_api import Page, expect

from dashboard.campaigns.spec import Arm, CampaignSpec
from dashboard.campaigns.store.listing import RunQuery
from dashboard.client import Client
from services.models.mission import Limits, MissionSpec
from tests.conftest import wait_until
from tests.dashboard.api.conftest import PATIENCE_S, Serving
from tests.dashboard.web.conftest import Looking

STRUCK_WITHIN_S = 150.0


def vehicle(page: Page) -> str | None:
    """Where the plan shows it, from west to east."""
    return page.locator(".layer-now circle").get_attribute("cx")


@pytest.fixture
def flying(client: Client) -> Iterator[str]:
    """A campaign of which one flight follows the other as long as a test looks."""
    spec = CampaignSpec(
        name="many",
        runs=500,
        mission=MissionSpec(limits=Limits(mission_time_s=10)),
        arms=(Arm(name="golden"),),
    )
    label = client.campaigns.create(spec).campaign
    yield label
    client.campaigns.command(label, "cancel")
    # Its last flight may still be under way, and would be shown to the next test.
    wait_until(lambda: all(one.campaign != label for one in client.processes().service), PATIENCE_S)


def shown_run(page: Page) -> int:
    """The number of the run that the page shows."""
    heading = page.get_by_role("heading", name=re.compile(r", run \d+$"))
    expect(heading).to_be_visible()
    return int(heading.inner_text().rpartition(" ")[2])


@pytest.mark.soak
def test_the_page_goes_on_to_the_next_flight_while_a_campaign_flies(
    service: Serving, looking: Looking, flying: str
) -> None:
    for path in ("/live", f"/live?flight={flying}"):
        page = looking.goto(service.address, path)
        first = shown_run(page)
        expect(page.get_by_role("heading", name=re.compile(rf", run {first}$"))).to_have_count(0)
        assert shown_run(page) != first
        expect(page.locator(".scene canvas")).to_have_count(1)
        assert page.url == service.address + path


@pytest.mark.soak
def test_a_run_that_the_address_names_stays_and_is_said_to_have_ended(
    service: Serving, client: Client, looking: Looking, flying: str
) -> None:
    page = looking.goto(service.address, f"/live?flight={flying}")
    run = shown_run(page)
    path = f"/live?flight={flying}&run={run}"
    for _ in range(2):  # watched to its end, or looked for afterwards
        looking.goto(service.address, path)
        ended = page.get_by_role("status").filter(has_text=f"Run {run} of {flying} has ended: ")
        expect(ended).to_be_visible()
        links = page.locator("#content")
        expect(links.get_by_role("link", name="Open the flight")).to_have_attribute(
            "href", f"/campaigns/{flying}/runs/{run}"
        )
        others = {line.id for line in client.runs.all(flying, RunQuery(phase="done"))}
        assert run in others
    links.get_by_role("link", name="Live flights").click()
    page.wait_for_url(f"{service.address}/live")
    assert shown_run(page) != run


def test_of_flights_that_are_not_there_the_answer_is_404(
    service: Serving, looking: Looking, flying: str
) -> None:
    looking.expected = ("404",)
    for path, said, leads_to in (
        ("/live?flight=none-1", "There is no campaign none-1.", "/live"),
        (f"/live?flight={flying}&run=987654", f"{flying} has no run 987654", f"/campaigns/{flying}"),
    ):
        assert httpx.get(service.address + path, timeout=PATIENCE_S).status_code == 404
        page = looking.goto(service.address, path)
        expect(page.get_by_role("alert")).to_contain_text(said)
        expect(page.get_by_role("alert").get_by_role("link")).to_have_attribute("href", leads_to)


def test_where_nothing_flies_the_page_says_what_to_do(service: Serving, looking: Looking) -> None:
    page = looking.goto(service.address, "/live")
    expect(page.get_by_role("status")).to_contain_text("No flight is under way.")
    page.get_by_label("Seed").fill("-1")
    page.get_by_label("Seed").blur()
    looking.expected = ("404",)
    page.goto(f"{service.address}/live?flight=flight-987")
    expect(page.get_by_role("alert")).to_contain_text("flight-987")


def test_a_flight_is_started_and_watched(service: Serving, client: Client, looking: Looking) -> None:
    page = looking.goto(service.address, "/live")
    page.get_by_role("button", name="Fly", exact=True).click()
    page.wait_for_url(re.compile("flight="))
    watched = page.url.partition("flight=")[2].partition("&")[0]

    time = page.locator(".reading-value").first
    expect(time).to_have_text(re.compile(r"^\d+\.\d s$"))
    page.evaluate("window.before = 1")
    first, place = time.inner_text(), vehicle(page)
    expect(time).not_to_have_text(first)
    expect(page.locator(f'.layer-now circle[cx="{place}"]')).to_have_count(0)
    expect(page.locator(".scene canvas")).to_be_visible()
    expect(page.locator(".depth img").first).to_have_attribute("src", re.compile("^data:image/png"))
    expect(page.locator(".layer-map image")).to_have_count(1)
    expect(page.locator('.layer-paths polyline[points*=" "]')).to_have_count(1)  # its twin has not flown
    commands = page.locator(".curve")
    assert commands.evaluate(
        "element => getElement(Number(element.id.slice(1))).chart.getOption().series[0].data.length > 1"
    )
    assert page.evaluate("window.before") == 1
    assert client.flights.sight(watched).map is not None
    client.campaigns.command(watched, "cancel")
    expect(page.get_by_text(re.compile("has ended: the campaign was cancelled"))).to_be_visible()


@pytest.mark.soak
def test_a_flight_under_way_is_struck_by_hand(service: Serving, client: Client, looking: Looking) -> None:
    # Long enough for a browser to strike it, and no longer: two more follow, to their ends.
    spec = MissionSpec(mission="scanning", seed=7, limits=Limits(mission_time_s=STRUCK_WITHIN_S))
    watched = client.flights.create(spec).campaign.campaign
    page = looking.goto(service.address, f"/live?flight={watched}")
    time = page.locator(".reading-value").first
    expect(time).to_have_text(re.compile(r"^\d+\.\d s$"))
    page.get_by_label("Strikes").fill("command.vx")
    page.get_by_role("option", name="state command.vx", exact=True).click()
    shown_s = float(time.inner_text().partition(" ")[0])
    page.get_by_role("button", name="Inject now").click()
    page.wait_for_url(re.compile(f"flight=(?!{watched}(&|$))"))
    struck = page.url.partition("flight=")[2].partition("&")[0]
    client.campaigns.command(watched, "cancel")  # the other waits for it
    expect(page.get_by_text("its golden twin flies first")).to_be_visible()

    expect(page.get_by_role("link", name="Open the flight")).to_be_visible()
    outcome = client.runs.outcome(struck, client.flights.get(struck).run.id)
    assert outcome.injection is not None
    assert outcome.injection.state == ["command.vx"]
    assert outcome.injection.virtual_time_ns / 1e9 >= shown_s
    page.get_by_role("link", name="Open the flight").click()
    expect(page.get_by_role("heading", name="Injection")).to_be_visible()


@pytest.mark.soak
def test_a_flight_that_waits_and_then_flies_is_shown_by_itself(
    service: Serving, client: Client, looking: Looking
) -> None:
    spec = MissionSpec(mission="scanning", limits=Limits(mission_time_s=60))
    first, second = (client.flights.create(spec).campaign.campaign for _ in range(2))
    page = looking.goto(service.address, f"/live?flight={second}")
    expect(page.get_by_role("status")).to_contain_text(f"{second} is about to fly.")
    expect(page.get_by_role("heading", name=re.compile(f"^{second}, run"))).to_be_visible()
    assert client.flights.get(first).campaign.phase == "done"
