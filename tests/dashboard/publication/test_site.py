"""The site of a campaign: every link leads to a file of the folder, nothing outside is asked for."""

import json
import re
from contextlib import closing
from pathlib import Path

import pytest

from dashboard.campaigns.events import Begin, Flown, Leased, RunStarted
from dashboard.campaigns.spec import Arm, CampaignSpec
from dashboard.campaigns.store.store import Store
from dashboard.publication.site import publish
from deploy.errors import BadSpecError
from services.models.faults.specification import FaultSpec
from services.models.oracles.harm import HarmEvent
from services.models.outcome import NO_FLIGHT, GoldenTwin, InjectionRecord, Outcome, TopicReport
from tests.dashboard.command import refusal

FLOWN = NO_FLIGHT.model_copy(update={"success": True, "flight_time_s": 20.0})
ARMS = (Arm(name="golden"), Arm(name="pid", fault=FaultSpec(target="pid")))
SPEC = CampaignSpec(name="x", runs=2, arms=ARMS)
MARKUP = "<script>alert(1)</script>"
NAMESPACES = "www[.]w3[.]org|purl[.]org|creativecommons[.]org|matplotlib[.]org"


def lost(spec: CampaignSpec) -> Outcome:
    """A flight that was lost, with a name of a function that is markup."""
    return Outcome(
        spec=spec.mission,
        result="collision",
        qof=FLOWN.model_copy(update={"success": False, "flight_time_s": 12.3}),
        digest="own",
        wall_s=1.0,
        nodes={},
        topics={"command": TopicReport(messages=9, digest="b", diverged_at_s=8.25)},
        injection=InjectionRecord(
            status="injected",
            node="control",
            kernel="pid",
            invocation=1,
            bits=[3],
            symbol=MARKUP,
        ),
        golden=GoldenTwin(result="success", qof=FLOWN, digest="twin"),
        harm=[HarmEvent(kind="mission_lost", at_ns=12_300_000_000)],
    )


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A store with one campaign: a golden flight and one that a fault harmed, of two runs a cell."""
    folder = tmp_path / "store"
    with closing(Store(folder)) as opened:
        campaign = opened.create(SPEC)
        planned = opened.planned(campaign)
        states, outcomes = opened.states(campaign), {}
        states.handle(Begin())
        for number in [number for number, run in planned.items() if run.index == 0]:
            for event in (Leased("l", (number,), 9.0), RunStarted("l", number), Flown("l", number)):
                states.handle(event)
            faulty = planned[number].arm == "pid"
            good = lost(SPEC).model_copy(
                update={"result": "success", "qof": FLOWN, "injection": None, "golden": None, "harm": None}
            )
            outcomes[number] = lost(SPEC) if faulty else good
        opened.write(campaign, states, list(outcomes), outcomes)
    return folder


def published(store: Path, folder: Path) -> int:
    with closing(Store(store)) as opened:
        return publish(opened, opened.find("x-1"), folder)


def test_every_link_leads_to_a_file_and_nothing_outside_is_asked_for(store: Path, tmp_path: Path) -> None:
    assert published(store, tmp_path / "site") == 1
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) == 2
    for page in pages:
        text = page.read_text()
        for link in re.findall(r'(?:href|src)="([^"#]+)"', text):
            assert (page.parent / link).is_file(), link
        assert not re.search(
            r"<script|https?://(?!www[.]w3[.]org|purl[.]org|creativecommons[.]org|matplotlib[.]org)", text
        )


def test_a_harmful_flight_says_why_and_is_there_to_be_flown_again(store: Path, tmp_path: Path) -> None:
    published(store, tmp_path / "site")
    index = (tmp_path / "site" / "index.html").read_text()
    assert "pid, sparse: 0 of 1 missions succeeded" in index
    (flight,) = (tmp_path / "site" / "flights").glob("*.html")
    text = flight.read_text()
    assert "The mission ended in collision after 12.30 s" in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in text
    outcome = Outcome.model_validate_json(flight.with_suffix(".json").read_text())
    assert outcome == lost(SPEC)
    assert json.loads((tmp_path / "site" / "campaign.json").read_text())["name"] == "x"
    assert len((tmp_path / "site" / "runs.csv").read_text().splitlines()) == 5


def test_a_folder_with_something_in_it_is_left_alone(store: Path, tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    kept.mkdir()
    (kept / "mine.txt").write_text("mine")
    with pytest.raises(BadSpecError, match="name a new folder"):
        published(store, kept)
    assert [one.name for one in kept.iterdir()] == ["mine.txt"]
    assert "name a new folder" in refusal("publish", "x-1", kept, "--store", store)
    assert "no campaign" in refusal("publish", "y-1", tmp_path / "y", "--store", store)
    assert "no arm 'z'" in refusal("publish", "x-1", tmp_path / "z", "--against", "z", "--store", store)
