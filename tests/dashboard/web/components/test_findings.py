"""What a campaign has found stands on the pages, in figures and in charts."""

from typing import Any

import pytest
from playwright.sync_api import Locator, Page, expect

from dashboard.campaigns.presets import scaled
from dashboard.campaigns.spec import Arm, CampaignSpec, load_campaign
from services.models.faults.specification import FaultSpec
from tests.dashboard.api.conftest import Serving
from tests.dashboard.web.conftest import Looking
from tests.dashboard.web.stored import stored

ARMS = (Arm(name="golden"), Arm(name="flip", fault=FaultSpec(target="pid")))


@pytest.fixture(scope="module")
def label(service: Serving) -> str:
    """A campaign of 2 x 8 flights, of which two have collided."""
    return stored(service, CampaignSpec(name="found", runs=8, arms=ARMS))


def titled(page: Page, title: str) -> Locator:
    """The chart below a title."""
    return page.locator(".caption").get_by_text(title, exact=True).locator("xpath=following-sibling::*[1]")


def drawn(chart: Locator) -> dict[str, list[Any]]:
    """The values that a chart draws, by the names, or else the types, of its series."""
    options = "getElement(Number(element.id.slice(1))).chart?.getOption().series"
    chart.page.wait_for_function(f"element => {options}?.length", arg=chart.element_handle())
    found: dict[str, list[Any]] = chart.evaluate(
        f"element => Object.fromEntries({options}.map("
        "one => [one.name || one.type, one.data.map(at => at.value)]))"
    )
    return found


def row(table: Locator, first: str) -> list[str]:
    """The texts of the row that begins so."""
    cells = table.locator("tbody tr").filter(has=table.page.get_by_text(first, exact=True)).first
    expect(cells).to_be_visible()
    return cells.locator("td").all_inner_texts()


def test_success_and_quality_stand_beside_their_intervals(
    service: Serving, looking: Looking, label: str
) -> None:
    page = looking.goto(service.address, f"/campaigns/{label}")
    expect(page.locator(".words")).to_have_text("16 of 16 flown")
    quality = page.locator(".figures").first
    assert row(quality, "golden")[:3] == ["golden", "8 of 8", "100 (68 to 100)"]
    flip = row(quality, "flip")
    assert flip[1:4] == ["8 of 8", "75 (41 to 93)", "24.0 (21.4 to 26.6)"]
    assert flip[-4:] == ["8 of 8", "-", "4 benign, 2 crash, 2 sdc", "-"]

    beside = page.locator(".figures").nth(1)
    told = row(beside, "flip / sparse")
    assert told[1:3] == ["8", "6, 8"]
    assert told[3].startswith("-25 (")
    assert told[5].startswith("+4.0 (")


def test_charts_draw_what_the_tables_say(service: Serving, looking: Looking, label: str) -> None:
    page = looking.goto(service.address, f"/campaigns/{label}")
    success = drawn(titled(page, "Success, %"))
    assert success["bar"] == [100, 75]
    assert [[round(at) for at in one] for one in success["custom"]] == [[68, 100, 0], [41, 93, 1]]
    assert drawn(titled(page, "Outcome of missions")) == {"success": [100, 75], "collision": [0, 25]}
    nodes = drawn(titled(page, "Outcome of the injected nodes"))
    assert nodes == {"benign": [50], "sdc": [25], "crash": [25]}
    times = drawn(titled(page, "flight time, s"))
    assert times["successful flights"] == [[20] * 5, [21, 22.25, 24, 25.75, 27]]
    assert sorted(at for at, _ in times["success"]) == [20] * 8 + [21, 22, 23, 25, 26, 27]
    assert [at for at, _ in times["failure"]] == [24, 28]
    assert [at for at, _ in drawn(titled(page, "energy, kJ"))["failure"]] == [12, 14]


def test_what_was_struck_is_told_by_bits_and_by_groups(
    service: Serving, looking: Looking, label: str
) -> None:
    page = looking.goto(service.address, f"/campaigns/{label}")
    heat = page.locator(".heat")
    fields = drawn(heat)["heatmap"]
    assert [percent for _, _, percent in fields] == [0, 0, 100]
    page.get_by_role("button", name="nodes silently wrong (sdc)").click()
    expect(page.locator(".heat[aria-label^='nodes silently wrong']")).to_be_visible()
    assert [percent for _, _, percent in drawn(heat)["heatmap"]] == [0, 100, 0]

    groups = page.locator(".figures.narrow")
    assert row(groups, "rbx") == ["rbx", "4"] + ["50 (15 to 85)"] * 3
    page.get_by_label("Divide by").get_by_role("button", name="module").click()
    assert row(groups, "libstruck.so")[:3] == ["libstruck.so", "8", "25 (7 to 59)"]


def test_the_first_page_shows_success_per_arm(service: Serving, looking: Looking, label: str) -> None:
    page = looking.goto(service.address)
    card = page.locator("article").filter(has=page.get_by_role("link", name=label, exact=True))
    expect(card.locator(".phase")).to_have_text("done")
    expect(card.locator(".arm")).to_have_count(2)
    expect(card.locator(".arm").nth(1)).to_have_text("flip6 of 8 (41 to 93 %)")
    green, whole = (card.locator(name).nth(1).bounding_box() for name in (".arm-part", ".arm-bar"))
    assert green is not None
    assert whole is not None
    assert green["width"] / whole["width"] == pytest.approx(0.75, abs=0.01)


def test_a_study_stands_beside_the_paper(service: Serving, looking: Looking) -> None:
    label = stored(service, scaled(load_campaign("fig7"), 0.04))
    page = looking.goto(service.address, "/studies")
    study = page.locator("#fig7")
    expect(study.get_by_role("link", name=label)).to_be_visible()
    longest = row(study.locator(".figures").first, "longest flight over its golden twin")
    assert longest == ["longest flight over its golden twin", "57.3", "15.0", "%"]
    chart = drawn(study.locator(".chart"))
    assert [at for at, _ in chart["paper"]] == [57.3, 8]
    assert [at for at, _ in chart["ours"]] == pytest.approx([15, 25])
    expect(page.locator("#fig9")).to_contain_text("zenfi campaign run fig9")
