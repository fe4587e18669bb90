"""The page of a run, in a browser, on real flights."""

import re
from itertools import pairwise
from math import log10
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from dashboard.analysis.recordings_reader import open_run
from dashboard.campaigns.spec import Arm, CampaignSpec, RecordingPolicy, Run
from dashboard.campaigns.store.listing import RunQuery
from dashboard.client import Client
from services.models.faults.specification import FaultSpec, Trigger
from services.models.mission import Limits, MissionSpec
from services.models.oracles.harm import HarmEvent
from services.models.oracles.properties import PropertyResult
from services.models.outcome import Outcome
from tests.dashboard.api.conftest import Serving
from tests.dashboard.web.conftest import Looking
from tests.dashboard.web.stored import ended, stored

FAULT = FaultSpec(level="source", target="command.vx", bit_numbers=(62,), trigger=Trigger(invocation=60))
SPEC = CampaignSpec(
    name="flown",
    runs=1,
    mission=MissionSpec(seed=7, limits=Limits(mission_time_s=5)),
    arms=(Arm(name="golden"), Arm(name="flip", fault=FAULT)),
)
WATCHED = {"detector": {"scheme": "gaussian"}}
DEAF = {"detector": {"scheme": "gaussian", "recovery": "off"}}
KEPT = SPEC.model_copy(
    update={
        "name": "kept",
        "arms": (
            *SPEC.arms,
            Arm(name="watched", mission=WATCHED),
            Arm(name="recomputed", mission=WATCHED, fault=FAULT),
            Arm(name="watched only", mission=DEAF, fault=FAULT),
            Arm(name="unseen", mission=WATCHED, fault=FAULT.model_copy(update={"bit_numbers": (0,)})),
        ),
        "recording": RecordingPolicy(keep="all"),
    }
)


def flown(service: Serving, spec: CampaignSpec) -> dict[str, str]:
    """The paths of the runs of a campaign, one an arm, by their arms."""
    with Client(service.address) as client:
        label = client.campaigns.create(spec).campaign
        assert list(client.watch(label))[-1].data.phase == "done"
        return {run.arm: f"/campaigns/{label}/runs/{run.id}" for run in client.runs.all(label, RunQuery())}


@pytest.fixture(scope="module")
def runs(service: Serving) -> dict[str, str]:
    """A golden and a struck run, not recorded."""
    return flown(service, SPEC)


@pytest.fixture(scope="module")
def kept(service: Serving) -> dict[str, str]:
    """A golden and a struck run, and the same with a detector, recorded."""
    return flown(service, KEPT)


def harmed(run: Run) -> Outcome:
    """A flight that was too close to an obstacle, and took too long."""
    outcome = ended(run)
    if outcome.injection is None:
        return outcome
    events = [
        HarmEvent(kind="property_violated", at_ns=2_000_000_000, property="always clearance >= 0.8"),
        HarmEvent(kind="too_slow", at_ns=30_000_000_000),
    ]
    properties = [
        PropertyResult(property="always clearance >= 0.8", robustness=-0.3, holds=False, at_ns=2_000_000_000),
        PropertyResult(property="always speed <= 5", robustness=1.25, holds=True, at_ns=21_000_000_000),
    ]
    return outcome.model_copy(update={"harm": events, "properties": properties})


def vehicles(page: Page) -> list[tuple[str | None, str | None]]:
    """Where the plan shows them."""
    circles = page.locator(".layer-now circle").all()
    return [(one.get_attribute("cx"), one.get_attribute("cy")) for one in circles]


@pytest.mark.soak
def test_a_run_is_recorded_looked_through_replayed_and_taken_away(
    service: Serving, client: Client, looking: Looking, runs: dict[str, str], tmp_path: Path
) -> None:
    page = looking.goto(service.address, runs["flip"])
    card = page.locator(".bit.corrupted")
    expect(card).to_have_count(1)
    assert card.get_attribute("title") in ("bit 62: 0, then 1", "bit 62: 1, then 0")
    expect(page.get_by_role("button", name="Download MCAP")).to_be_disabled()

    expect(page.get_by_text("There is no recording of this run.")).to_be_visible()
    page.get_by_role("button", name="Record", exact=True).click()
    expect(page.locator(".scene canvas")).to_be_visible()
    expect(page.locator(".curve canvas").first).to_be_visible()
    travelled = page.get_by_role("region", name="How the fault propagated")
    expect(travelled.locator("tbody tr").first).to_contain_text("command")
    expect(travelled.locator("tbody tr").first).to_contain_text("fault")

    now = page.locator(".now")
    expect(now).to_contain_text("m from golden")
    told, before = now.inner_text(), vehicles(page)
    assert len(before) == 2
    assert told.startswith("2.40 s, tick 60"), "it begins where the fault struck"
    page.get_by_role("button", name="Play", exact=True).focus()
    page.keyboard.press("Tab")
    page.keyboard.press("ArrowRight")
    expect(now).to_contain_text("2.44 s, tick 61")
    slider = page.get_by_role("slider", name="Moment of the flight")
    box = slider.bounding_box()
    assert box is not None
    slider.click(position={"x": box["width"] - 2, "y": box["height"] / 2})
    expect(now).to_contain_text(re.compile(r"^(4\.9|5)"))
    assert vehicles(page) != before
    expect(now).to_contain_text(re.compile(r"0\.00[1-9] m from golden"))  # of one command in 125

    with page.expect_download() as download:
        page.get_by_role("button", name="Download MCAP").click()
    download.value.save_as(tmp_path / "run.mcap")
    label, run = runs["flip"].split("/")[2::2]
    outcome = client.runs.outcome(label, int(run))
    recording = open_run(tmp_path / "run.mcap")
    assert recording.spec == outcome.spec
    assert recording.about["digest"] == outcome.digest
    assert len(recording.table("command")["ready_ns"]) == outcome.topics["command"].messages
    assert client.runs.recording(label, int(run)) == (tmp_path / "run.mcap").read_bytes()

    page.get_by_role("button", name="Open in a viewer").click()
    expect(page.locator(".q-dialog")).to_contain_text("zenfi view")
    page.get_by_role("button", name="Close").click()
    page.get_by_role("button", name="Replay", exact=True).click()
    expect(page.get_by_text("Replay: replayed")).to_be_visible()


@pytest.mark.soak
def test_a_run_of_a_campaign_that_keeps_recordings_is_drawn_at_once(
    service: Serving, looking: Looking, kept: dict[str, str]
) -> None:
    page = looking.goto(service.address, kept["recomputed"])
    expect(page.locator(".now")).to_contain_text("recomputed is 0.000 m from golden")
    expect(page.get_by_role("button", name="Record", exact=True)).to_have_count(0)
    keys = page.locator(".legend").first.locator(".key")
    assert keys.all_inner_texts() == [
        "golden",
        "injected",
        "with detector",
        "recomputed",
        "fault",
        "alarm",
    ]
    assert len(vehicles(page)) == 4
    nodes, alarms = (page.get_by_role("region", name=name) for name in ("Nodes", "Alarms"))
    expect(nodes.locator("tr", has_text="control").locator("td").nth(-1)).not_to_have_text("0")
    expect(alarms.locator("tbody tr").first).to_contain_text("command.vx")
    expect(page.get_by_text("Nobody complained.")).to_be_visible()


def test_a_flight_whose_detector_raised_no_alarm_is_called_what_it_is(
    service: Serving, looking: Looking, kept: dict[str, str]
) -> None:
    page = looking.goto(service.address, kept["unseen"])
    expect(page.locator(".now")).to_contain_text("with detector is 0.000 m from golden")
    keys = page.locator(".legend").first.locator(".key")
    assert keys.all_inner_texts() == ["golden", "with detector", "fault"]
    assert "recover" not in page.locator("#content").inner_text()


def test_another_state_is_drawn_when_it_is_chosen(
    service: Serving, looking: Looking, kept: dict[str, str]
) -> None:
    page = looking.goto(service.address, kept["flip"])
    panel = page.locator(".panel").filter(has=page.get_by_label("State"))
    expect(panel.locator(".curve")).to_have_attribute("aria-label", "command.vx (m/s) over time")
    page.get_by_label("State").fill("cloud.z")
    page.get_by_role("option", name="cloud.z").click()
    expect(panel.locator(".curve")).to_have_attribute(
        "aria-label", "cloud.z, mean of its points (m) over time"
    )


def test_a_logarithmic_axis_is_labelled_at_powers_of_ten(
    service: Serving, looking: Looking, kept: dict[str, str]
) -> None:
    page = looking.goto(service.address, kept["flip"])
    chart = page.locator(".curve[aria-label^='deviation']")
    expect(chart.locator("canvas")).to_be_visible()
    labels = chart.evaluate(
        "element => getElement(Number(element.id.slice(1))).chart.getModel()"
        ".getComponent('yAxis', 0).axis.scale.getTicks().map(one => one.value)"
    )
    steps = {round(log10(higher / lower), 6) for lower, higher in pairwise(labels)}
    assert len(labels) >= 4
    assert len(steps) == 1
    assert all(float(f"{one:.0e}") == pytest.approx(one) for one in labels)


def test_a_run_tells_what_harmed_it_and_by_how_much_its_properties_hold(
    service: Serving, client: Client, looking: Looking
) -> None:
    label = stored(service, SPEC, harmed)
    run = next(one.id for one in client.runs.all(label, RunQuery()) if one.arm == "flip")
    page = looking.goto(service.address, f"/campaigns/{label}/runs/{run}")
    expect(page.get_by_text("Harmed: property violated at 2.00 s, too slow at 30.00 s")).to_be_visible()
    rows = page.get_by_role("region", name="Properties").locator("tbody tr")
    assert [row.locator("td").all_inner_texts() for row in rows.all()] == [
        ["always clearance >= 0.8", "violated", "-0.3", "2.00"],
        ["always speed <= 5", "holds", "+1.25", "21.00"],
    ]


@pytest.mark.soak
def test_a_run_without_a_fault_is_flown_again(
    service: Serving, looking: Looking, runs: dict[str, str]
) -> None:
    page = looking.goto(service.address, runs["golden"])
    expect(page.get_by_role("button", name="Replay", exact=True)).to_be_disabled()
    expect(page.get_by_text("the same in flip")).to_be_visible()
    page.get_by_role("button", name="Fly again without fault").click()
    page.wait_for_url("**/live?flight=*")
    expect(page.get_by_role("link", name="Open the flight")).to_be_visible()


def test_on_a_telephone_nothing_hangs_over_the_edge(
    service: Serving, looking: Looking, runs: dict[str, str]
) -> None:
    looking.page.set_viewport_size({"width": 390, "height": 844})
    page = looking.goto(service.address, runs["flip"])
    expect(page.get_by_role("heading", name="Injection")).to_be_visible()
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
