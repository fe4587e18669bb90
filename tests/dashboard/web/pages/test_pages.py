"""People at a browser: they start a campaign, watch it, look through it, and take it away again."""

import re
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Locator, Page, expect

from dashboard.campaigns.spec import Arm, CampaignSpec
from dashboard.client import Client
from services.models.faults.specification import FaultSpec
from services.models.mission import Limits, MissionSpec
from tests.dashboard.api.conftest import PATIENCE_S, Serving, serving
from tests.dashboard.web.conftest import Looking
from tests.dashboard.web.stored import stored

SHORT = MissionSpec(limits=Limits(mission_time_s=0.6))
ARMS = (Arm(name="golden"), Arm(name="flip", fault=FaultSpec(target="pid")))
MARKUP = "<img src=x onerror=window.taken=1>"
TEMPLATE = "{{7*7}}${7*7}"


@pytest.fixture(scope="module")
def short(service: Serving) -> str:
    """A campaign of 2 x 4 flights that has ended."""
    return stored(service, CampaignSpec(name="short", runs=4, mission=SHORT, arms=ARMS))


@pytest.fixture(scope="module")
def long(service: Serving) -> Iterator[str]:
    """A campaign that does not end by itself while these tests run."""
    with Client(service.address) as client:
        yield client.campaigns.create(CampaignSpec(name="long", runs=2000, mission=SHORT, arms=ARMS)).campaign
        for line in client.campaigns.all():
            if line.phase in ("queued", "running", "paused"):
                client.campaigns.command(line.campaign, "cancel")


def rows(page: Page) -> list[list[str]]:
    """The texts of the table of runs."""
    found: list[list[str]] = page.locator(".runs tbody tr").evaluate_all(
        "rows => rows.map(row => [...row.cells].map(cell => cell.innerText))"
    )
    return found


def point_at_all(chart: Locator) -> None:
    """Have a chart tell of everything that it draws, as it does of what people point at."""
    chart.evaluate(
        "element => { const chart = getElement(Number(element.id.slice(1))).chart;"
        "chart?.getOption().series.forEach((one, seriesIndex) => one.data.forEach((_, dataIndex) =>"
        "chart.dispatchAction({type: 'showTip', seriesIndex, dataIndex}))) }"
    )


@pytest.mark.soak
def test_a_campaign_is_started_from_the_form_and_watched_without_loading_again(
    service: Serving, looking: Looking, client: Client
) -> None:
    page = looking.goto(service.address, "/new?preset=own")
    page.get_by_label("name", exact=True).fill("browser")
    page.get_by_label("flights per arm and world").fill("2")
    page.get_by_label("mission ends after, s").fill("1")
    page.get_by_label("detector that recomputes").click()
    page.get_by_role("option", name="gaussian").click()
    page.get_by_label("recordings to look through").click()
    page.get_by_role("option", name="of missions that failed").click()
    expect(page.locator(".forecast")).to_contain_text("6 flights in 3 cells")
    expect(page.locator(".forecast")).to_contain_text("2 flights a cell can tell")

    page.get_by_role("button", name="Start").click()
    page.wait_for_url(re.compile(r"/campaigns/browser-\d+$"))
    page.evaluate(
        "() => { const words = document.querySelector('.words'); window.seen = [words.innerText];"
        "new MutationObserver(() => window.seen.push(words.innerText))"
        ".observe(words, {childList: true, characterData: true, subtree: true}) }"
    )
    expect(page.locator(".words")).to_contain_text("6 of 6 flown")
    expect(page.locator(".phase")).to_have_text("done")
    quality = page.locator(".figures").first
    expect(quality.locator("tbody tr")).to_have_count(3)
    expect(quality).to_contain_text("2 of 2")
    expect(page.get_by_text("No fault was injected yet.")).to_be_hidden()
    assert len(set(page.evaluate("window.seen"))) > 1
    assert len(rows(page)) == 6
    asked = client.campaigns.get(page.url.rpartition("/")[2]).spec
    assert asked.mission.detector is not None
    assert (asked.mission.detector.scheme, asked.recording.keep) == ("gaussian", "failures")


def test_a_form_that_cannot_be_flown_says_why(service: Serving, looking: Looking) -> None:
    page = looking.goto(service.address, "/new?preset=own")
    page.get_by_label("name", exact=True).fill("no spaces here")
    expect(page.locator(".wrong")).to_contain_text("name")
    expect(page.get_by_role("button", name="Start")).to_be_disabled()


def test_what_the_table_of_runs_shows_stands_in_the_address(
    service: Serving, looking: Looking, short: str
) -> None:
    page = looking.goto(service.address, f"/campaigns/{short}?limit=5")
    assert len(rows(page)) == 5
    page.get_by_role("button", name="Next").click()
    expect(page.locator(".runs tbody tr")).to_have_count(3)
    page.get_by_role("button", name="Previous").click()
    expect(page.locator(".runs tbody tr")).to_have_count(5)

    page.get_by_label("arm", exact=True).click()
    page.get_by_role("option", name="flip").click()
    expect(page.locator(".runs tbody tr")).to_have_count(4)
    page.locator(".runs th").filter(has_text="seed").click()
    page.get_by_label("largest first").click()
    page.wait_for_url(re.compile(r"arm=flip.*sort=seed.*descending=[Tt]rue"))
    assert {row[1] for row in rows(page)} == {"flip"}
    page.reload()
    expect(page.locator(".runs tbody tr")).to_have_count(4)
    seeds = [int(row[2]) for row in rows(page)]
    assert seeds == sorted(seeds, reverse=True)
    href = page.locator(".runs tbody a").first.get_attribute("href")
    assert href is not None
    assert re.fullmatch(rf"/campaigns/{short}/runs/\d+", href)


def test_back_undoes_sorting_and_paging_and_comes_back_from_a_run(
    service: Serving, looking: Looking, short: str
) -> None:
    page = looking.goto(service.address)
    page.get_by_role("link", name=short, exact=True).click()
    page.wait_for_url(f"**/campaigns/{short}")
    page = looking.goto(service.address, f"/campaigns/{short}?limit=3")

    def expect_rows(count: int, seeds: list[str], *, largest_first: bool) -> None:
        cells = page.locator(".runs tbody tr")
        expect(cells).to_have_count(count)
        expect(cells.locator("td:nth-child(3)")).to_have_text(seeds)
        sorted_by = page.get_by_label("largest first")
        expect(sorted_by).to_be_checked(checked=largest_first)
        assert f"/campaigns/{short}?" in page.url

    page.locator(".runs th").filter(has_text="seed").click()
    expect_rows(3, ["0", "0", "1"], largest_first=False)
    page.get_by_label("largest first").click()
    expect_rows(3, ["3", "3", "2"], largest_first=True)
    page.get_by_role("button", name="Next").click()
    expect_rows(3, ["2", "1", "1"], largest_first=True)
    page.get_by_role("button", name="Next").click()
    expect_rows(2, ["0", "0"], largest_first=True)

    page.locator(".runs tbody a").first.click()
    page.wait_for_url("**/runs/*")
    page.go_back()
    looking.await_connection()
    expect_rows(2, ["0", "0"], largest_first=True)
    page.get_by_role("button", name="Previous").click()
    expect_rows(3, ["2", "1", "1"], largest_first=True)
    for count, seeds, largest_first in (
        (2, ["0", "0"], True),
        (3, ["2", "1", "1"], True),
        (3, ["3", "3", "2"], True),
        (3, ["0", "0", "1"], False),
    ):
        page.go_back()
        expect_rows(count, seeds, largest_first=largest_first)
    page.go_back()
    expect(page.get_by_role("combobox", name="sorted by")).to_have_value("run")
    assert page.url == f"{service.address}/campaigns/{short}?limit=3"
    page.go_forward()
    expect(page.get_by_role("combobox", name="sorted by")).to_have_value("seed")
    assert "sort=seed" in page.url
    page.go_back()
    page.go_back()
    page.wait_for_url(f"{service.address}/campaigns/{short}")


def test_a_dot_opens_its_flight_and_the_map_of_bits_shows_what_one_asks_for(
    service: Serving, looking: Looking, short: str
) -> None:
    page = looking.goto(service.address, f"/campaigns/{short}")
    described = page.locator(".heat[aria-label]").first
    expect(described).to_have_attribute("aria-label", re.compile("missions failed"))
    page.get_by_role("button", name="nodes crashed or hung").click()
    expect(described).to_have_attribute("aria-label", re.compile("nodes crashed or hung"))

    chart = page.locator("#flights .chart").first
    chart.scroll_into_view_if_needed()
    # What is drawn last lies on top.
    x, y, run = chart.evaluate(
        "element => { const chart = getElement(Number(element.id.slice(1))).chart;"
        "const index = chart.getOption().series.findIndex(one => one.name === 'failure');"
        "const dot = chart.getOption().series[index].data.at(-1);"
        "return [...chart.convertToPixel({seriesIndex: index}, dot.value), dot.run] }"
    )
    chart.click(position={"x": x, "y": y})
    page.wait_for_url(f"**/campaigns/{short}/runs/{run}")


def test_exports_can_be_had_from_the_page(service: Serving, looking: Looking, short: str) -> None:
    page = looking.goto(service.address, f"/campaigns/{short}")
    with page.expect_download() as got:
        page.get_by_role("link", name="runs as CSV").click()
    assert len(Path(got.value.path()).read_text().splitlines()) == 9


@pytest.mark.soak
def test_a_campaign_is_paused_resumed_and_cloned(
    service: Serving, looking: Looking, client: Client, long: str
) -> None:
    page = looking.goto(service.address, f"/campaigns/{long}")
    phase, buttons = page.locator(".phase"), page.get_by_role("group", name=f"Commands for {long}")
    expect(phase).to_have_text("running")
    expect(page.locator(".words")).to_contain_text("left")
    buttons.get_by_role("button", name="pause").click()
    expect(phase).to_have_text("paused")
    expect(page.locator(".words")).not_to_contain_text("left")
    expect(buttons.get_by_role("button", name="pause")).to_be_hidden()
    buttons.get_by_role("button", name="resume").click()
    expect(phase).to_have_text("running")
    campaigns = [line.campaign for line in client.campaigns.all()]
    buttons.get_by_role("button", name="clone").click()
    dialog = page.get_by_role("dialog")
    expect(dialog).to_contain_text(f"Fly {long} again, as a new campaign?")
    expect(dialog).to_contain_text("long: 4000 flights in 2 cells")
    dialog.get_by_role("button", name="Back").click()
    expect(page.locator(".q-dialog")).to_have_count(0)
    assert [line.campaign for line in client.campaigns.all()] == campaigns
    buttons.get_by_role("button", name="clone").click()
    dialog.get_by_role("button", name="Fly", exact=True).click()
    page.wait_for_url(lambda url: "/campaigns/long-" in url and not url.endswith(long))

    # It waits for the other: it can be made to wait longer, and to go on is nothing to ask for.
    waiting = page.url.rpartition("/")[2]
    assert client.campaigns.get(waiting).spec == client.campaigns.get(long).spec
    buttons = page.get_by_role("group", name=f"Commands for {waiting}")
    expect(phase).to_have_text("queued")
    expect(buttons.get_by_role("button", name="resume")).to_be_hidden()
    buttons.get_by_role("button", name="pause").click()
    expect(phase).to_have_text("paused")
    expect(buttons.get_by_role("button", name="resume")).to_be_visible()


@pytest.mark.soak
def test_a_campaign_is_cancelled_and_deleted_after_a_question(
    service: Serving, looking: Looking, client: Client, long: str
) -> None:
    page = looking.goto(service.address)
    card = page.locator("article").filter(has=page.get_by_role("link", name=long, exact=True))
    expect(card.locator(".phase")).to_have_text("running")
    card.get_by_role("button", name="cancel").click()
    page.get_by_role("button", name="Back").click()
    expect(page.locator(".q-dialog")).to_have_count(0)
    assert client.campaigns.get(long).phase == "running"
    card.get_by_role("button", name="cancel").click()
    page.get_by_role("button", name="Cancel", exact=True).click()
    expect(card.locator(".phase")).to_have_text("cancelled")
    expect(card.get_by_role("button", name="cancel")).to_be_hidden()

    card.get_by_role("button", name="delete").click()
    page.get_by_role("button", name="Back").click()
    expect(page.locator(".q-dialog")).to_have_count(0)
    assert client.campaigns.get(long).phase == "cancelled"
    card.get_by_role("button", name="delete").click()
    page.get_by_role("button", name="Delete", exact=True).click()
    expect(card).to_have_count(0)
    assert long not in [line.campaign for line in client.campaigns.all()]


def test_a_campaign_that_others_delete_is_shown_as_deleted(
    service: Serving, looking: Looking, client: Client
) -> None:
    label = stored(service, CampaignSpec(name="passing", runs=1, mission=SHORT, arms=ARMS))
    page = looking.goto(service.address, f"/campaigns/{label}")
    expect(page.get_by_text("Quality of flight")).to_be_visible()
    client.campaigns.delete(label)
    expect(page.get_by_role("alert").filter(has_text="This campaign was deleted.")).to_be_visible()
    expect(page.get_by_text("Quality of flight")).to_be_hidden()
    looking.expected = ("404",)
    looking.goto(service.address, f"/campaigns/{label}")
    expect(page.get_by_role("alert").filter(has_text="no campaign")).to_be_visible()


def test_where_there_is_no_page_the_ways_to_the_others_stand(service: Serving, looking: Looking) -> None:
    looking.expected = ("404",)
    page = looking.goto(service.address, "/nothing-here")
    expect(page.get_by_role("alert")).to_contain_text("There is no page at this address.")
    page.get_by_role("link", name="Studies").click()
    expect(page.get_by_role("heading", level=1)).to_have_text("Studies")


@pytest.mark.parametrize(
    ("path", "said", "way", "leads_to"),
    [
        ("/campaigns/none-1", "There is no campaign none-1.", "All campaigns", "/"),
        ("/campaigns/none-1/runs/1", "There is no campaign none-1.", "All campaigns", "/"),
        (
            "/campaigns/{short}/runs/987654",
            "{short} has no run 987654",
            "Open the campaign",
            "/campaigns/{short}",
        ),
        ("/campaigns/{short}/runs/first", "There is no page at this address.", "All campaigns", "/"),
        ("/compare?first=none-1", "There is no campaign none-1.", "All campaigns", "/"),
        ("/live?run=first", "There is no page at this address.", "All campaigns", "/"),
        ("/studies/none", "There is no page at this address.", "All campaigns", "/"),
    ],
)
def test_of_what_is_not_there_the_answer_is_404_in_words_with_a_way_on(
    service: Serving, looking: Looking, short: str, path: str, said: str, way: str, leads_to: str
) -> None:
    looking.expected = ("404",)
    path, said, leads_to = (text.format(short=short) for text in (path, said, leads_to))
    answer = httpx.get(service.address + path, timeout=PATIENCE_S)
    assert (answer.status_code, answer.headers["content-type"]) == (404, "text/html; charset=utf-8")
    page = looking.goto(service.address, path)
    expect(page.get_by_role("alert")).to_contain_text(said)
    page.locator("#content").get_by_role("link", name=way, exact=True).click()
    page.wait_for_url(re.compile(re.escape(service.address + leads_to) + r"(\?.*)?$"))
    expect(page.get_by_role("alert")).to_have_count(0)


def test_every_page_says_that_it_is_in_english(service: Serving, looking: Looking, short: str) -> None:
    looking.expected = ("404",)
    run = httpx.get(f"{service.address}/api/v1/campaigns/{short}/runs").json()["runs"][0]["id"]
    of_one = (f"/campaigns/{short}", f"/campaigns/{short}/runs/{run}")
    for path in ("/", "/new", "/live", "/compare", "/studies", "/system", "/login", "/nothing-here", *of_one):
        assert '<html lang="en">' in httpx.get(service.address + path, timeout=PATIENCE_S).text, path
        looking.goto(service.address, path)
        assert looking.page.evaluate("document.documentElement.lang") == "en", path


def test_names_that_people_type_are_never_markup(service: Serving, looking: Looking) -> None:
    looking.expected = ("404",)  # of a campaign that is called so there is none
    arms = (Arm(name=MARKUP), Arm(name=TEMPLATE, fault=FaultSpec(target="pid")))
    label = stored(service, CampaignSpec(name="markup", runs=2, mission=SHORT, arms=arms))
    for path in (
        "/",
        f"/campaigns/{label}?arm={MARKUP}",
        f"/compare?first={label}&arm={MARKUP}",
        f"/compare?first={MARKUP}",
    ):
        page = looking.goto(service.address, path)
        expect(page.get_by_text(MARKUP).first).to_be_visible()
        for chart in page.locator(".chart").all():
            point_at_all(chart)
        assert page.locator("img").count() == 0
        assert page.evaluate("window.taken") is None
        assert re.search(r"49\$|[$}]49", page.locator("body").inner_text()) is None


def test_two_arms_and_two_campaigns_are_compared(
    service: Serving, looking: Looking, client: Client, short: str
) -> None:
    again = stored(service, client.campaigns.get(short).spec)
    page = looking.goto(service.address, f"/compare?first={short}&second={again}")
    expect(page.get_by_text(f"Beside {again}")).to_be_visible()
    expect(page.locator(".figures").first.locator("tbody tr")).to_have_count(2)
    page.get_by_label("beside").click()
    page.get_by_role("option", name="arm golden").click()
    expect(page.get_by_text("Beside golden", exact=True)).to_be_visible()
    assert "arm=golden" in page.url
    page.go_back()
    expect(page.get_by_text(f"Beside {again}")).to_be_visible()
    assert f"second={again}" in page.url


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_every_page_fits_a_narrow_screen_in_light_and_dark(
    service: Serving, looking: Looking, short: str, theme: str
) -> None:
    page = looking.page
    page.set_viewport_size({"width": 390, "height": 800})
    page.emulate_media(color_scheme="dark" if theme == "dark" else "light")
    for path in ("/", "/new", "/new?preset=own", "/compare", "/studies", f"/campaigns/{short}"):
        looking.goto(service.address, path)
        expect(page.get_by_role("heading", level=1)).to_be_visible()
        assert page.evaluate("document.documentElement.scrollWidth") <= 390, path
        assert page.evaluate("document.body.classList.contains('body--dark')") == (theme == "dark")


def test_a_theme_that_was_chosen_stays_and_keys_reach_everything(service: Serving, looking: Looking) -> None:
    page = looking.goto(service.address)
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.innerText") == "Skip to content"
    for _ in range(20):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.getAttribute('aria-label')") == "Light or dark":
            break
    page.keyboard.press("Enter")
    page.wait_for_function("document.body.classList.contains('body--dark')")
    looking.goto(service.address, "/studies")
    assert page.evaluate("document.body.classList.contains('body--dark')")


@pytest.mark.soak
def test_a_stopped_server_is_told_and_the_page_comes_back_by_itself(tmp_path: Path, looking: Looking) -> None:
    with serving(tmp_path) as one:
        port = int(one.address.rsplit(":", 1)[1])
        page = looking.goto(one.address)
        expect(page.get_by_text("No campaigns yet.")).to_be_visible()
        looking.expected = ("net::ERR_", "WebSocket connection")
        one.kill()
        expect(page.get_by_text("Connection lost.")).to_be_visible()
    with serving(tmp_path, port=port) as again:
        expect(page.get_by_text("Connection lost.")).to_be_hidden()
        label = stored(again, CampaignSpec(name="after", runs=1, mission=SHORT, arms=ARMS))
        expect(page.get_by_role("link", name=label)).to_be_visible()
