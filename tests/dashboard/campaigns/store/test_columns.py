"""The runs of a campaign as an array are what the store has, and only what has changed is read again."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import sqlalchemy as sa

from dashboard.campaigns.spec import cells
from dashboard.campaigns.store import columns
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.campaigns.store.store import Store
from services.models.outcome import GoldenTwin, Outcome
from tests.dashboard.campaigns.store.test_store import SPEC, flown, outcome


def detected(digest: str) -> Outcome:
    """A flight whose twin's digest is known."""
    twin = outcome("d")
    return outcome(digest).model_copy(
        update={"golden": GoldenTwin(result=twin.result, qof=twin.qof, digest="d"), "harm": None}
    )


def write(store: Store, campaign: CampaignEntry, run: int, one: Outcome) -> None:
    store.write(campaign, store.states(campaign), [], {run: one})


def assert_as_stored(store: Store, campaign: CampaignEntry) -> None:
    """The array says what the records say, field by field."""
    expected = columns.of_records(cells(campaign.spec), store.records(campaign))
    found = store.columns(campaign)
    for name in columns.COLUMNS.names or ():
        if name.startswith("artefact"):
            continue  # records do without
        np.testing.assert_array_equal(found[name], expected[name])


def test_the_array_is_what_the_records_say(store: Store) -> None:
    store.create(SPEC)
    campaign = store.create(SPEC)
    assert_as_stored(store, campaign)
    first = min(store.planned(campaign))
    flown(store, campaign, first + 3)
    assert_as_stored(store, campaign)
    flown(store, campaign, first)
    assert_as_stored(store, campaign)
    assert store.columns(campaign)["phase"].tolist() == [
        "done",
        "queued",
        "queued",
        "done",
        "queued",
        "queued",
    ]


def test_what_did_not_change_is_not_read_again(store: Store) -> None:
    campaign = store.create(SPEC)
    flown(store, campaign, 2)
    before = store.columns(campaign)
    assert store.columns(campaign) is before
    with store.database.writing() as connection:
        connection.execute(sa.text("UPDATE results SET energy_kj = 7"))  # as no store does
    flown(store, campaign, 3)
    after = store.columns(campaign)
    assert after["energy_kj"].tolist()[1:3] == [0.0, 0.0]
    assert after["phase"].tolist()[1:3] == ["done", "done"]
    assert before["phase"][2] == "queued"


def test_another_process_that_flies_is_seen(store: Store) -> None:
    campaign = store.create(SPEC)
    assert store.columns(campaign)["phase"].tolist() == ["queued"] * 6
    other = Store(store.where)
    try:
        flown(other, other.find("1"), 4)
    finally:
        other.close()
    assert store.columns(campaign)["phase"].tolist()[3] == "done"


def test_a_flight_is_its_twin_if_the_digests_are_the_same(store: Store) -> None:
    campaign = store.create(SPEC)
    for run, one in ((2, detected("d")), (4, detected("other")), (6, outcome())):
        write(store, campaign, run, one)
    found = store.columns(campaign)
    assert found["has_twin"].tolist() == [False, True, False, True, False, False]
    assert found["as_twin"].tolist() == [False, True, False, False, False, False]
    assert_as_stored(store, campaign)


def test_only_so_many_runs_are_kept(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(columns, "MOST_ROWS", 12)
    several = [store.create(SPEC) for _ in range(3)]
    first, second, third = (store.columns(one) for one in several)
    assert store.columns(several[2]) is third
    assert store.columns(several[1]) is second
    assert store.columns(several[0]) is not first


def test_many_may_read_while_it_is_flown(store: Store) -> None:
    campaign = store.create(SPEC)

    def done() -> list[int]:
        return [int((store.columns(campaign)["phase"] == "done").sum()) for _ in range(20)]

    with ThreadPoolExecutor(4) as readers:
        reading = [readers.submit(done) for _ in range(4)]
        for run in range(1, 7):
            flown(store, campaign, run)
        for one in reading:
            assert one.result() == sorted(one.result())
    assert store.columns(campaign)["phase"].tolist() == ["done"] * 6
