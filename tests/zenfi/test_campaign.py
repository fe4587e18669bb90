"""``zenfi.Campaign``: flown, resumed, opened again, as tables and plots, here and with a service alike."""

from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

import zenfi
from dashboard.campaigns.scheduler import Finished
from tests.dashboard.api.conftest import serving
from tests.dashboard.command import zenfi as command
from zenfi.campaign import FlownCampaign

FIELDS: dict[str, Any] = {
    "name": "guards",
    "runs": 2,
    "arms": {"ours": {}, "bare": {"guards": ["clip", "restart"]}},
    "faults": {"golden": None, "position": "source:trajectory.position,field=exponent"},
}


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("store")


@pytest.fixture(scope="module")
def flown(store: Path) -> zenfi.StoredCampaign:
    return zenfi.Campaign(**FIELDS).run(store=store, progress=False)


def rows(found: FlownCampaign) -> str:
    """The table of a campaign but for what tells of the run and not of the flight."""
    return str(found.table().pandas().drop(columns=["wall_s", "attempts"]).to_csv())


def test_a_campaign_is_flown_and_told(flown: zenfi.StoredCampaign) -> None:
    assert (flown.label, flown.phase) == ("guards-1", "done")
    assert repr(flown) == "<campaign guards-1: done>"
    assert [(one.arm, one.fault, one.runs) for one in flown.summary()] == [
        ("ours", "golden", 2),
        ("ours", "position", 2),
        ("bare", "golden", 2),
        ("bare", "position", 2),
    ]
    table = flown.table()
    assert table.rows == 8
    assert table["success"].dtype == np.bool_
    assert list(table.polars()["fault"].unique().sort()) == ["golden", "position"]
    assert len(list(flown.outcomes())) == 8
    assert [one.cell for one in flown.compare(against="ours")] == [
        "bare / sparse / golden",
        "bare / sparse / position",
    ]


def test_it_is_drawn_and_shown(flown: zenfi.StoredCampaign, tmp_path: Path) -> None:
    flown.plot().savefig(tmp_path / "quality.png")
    assert (tmp_path / "quality.png").stat().st_size > 5000
    paper = Console(width=100, record=True, file=StringIO())
    paper.print(flown)
    assert "bare" in paper.export_text()
    shown = getattr(flown, "_repr_mimebundle_")((), ())  # noqa: B009 - as notebooks ask for it
    assert "bare" in shown["text/html"]


def test_the_command_finds_it_and_it_finds_the_commands(flown: zenfi.StoredCampaign, store: Path) -> None:
    assert "guards-1: done, 8 of 8 flown" in command("campaign", "show", "guards-1", "--store", store).stderr
    assert [one.label for one in zenfi.campaigns(store=store)] == [flown.label]
    again = zenfi.open_campaign(flown.label, store=store)
    assert rows(again) == rows(flown)
    with pytest.raises(zenfi.BadSpecError, match="guards-9"):
        zenfi.open_campaign("guards-9", store=store)


def test_what_is_created_is_flown_later(store: Path) -> None:
    asked = zenfi.Campaign(name="later", runs=2, arms={"ours": {}})
    plan = asked.forecast(store=store)
    assert (plan.runs, plan.cells) == (2, 1)
    created = asked.create(store=store)
    assert str(created) == "<campaign later-2: queued>"
    told: list[Finished] = []
    created.fly(progress=False, each=told.append)
    assert str(created) == "<campaign later-2: done>"
    assert len(told) == 2


def test_a_service_flies_the_same(flown: zenfi.StoredCampaign, tmp_path: Path) -> None:
    with serving(tmp_path / "service") as running, zenfi.connect(running.address) as service:
        there = service.Campaign(**FIELDS).run(progress=False)
        assert (there.label, there.phase) == ("guards-1", "done")
        assert rows(there) == rows(flown)
        assert [one.digest for one in there.outcomes()] == [one.digest for one in flown.outcomes()]
        assert there.summary() == flown.summary()
        assert there.compare(against="ours") == flown.compare(against="ours")
        assert service.fly(seed=7).digest == zenfi.fly(seed=7).digest
        assert "guards-1" in [one.label for one in service.campaigns()]
        assert service.open_campaign("guards-1").spec == flown.spec
        with pytest.raises(zenfi.RequestRefusedError, match="guards-9"):
            service.open_campaign("guards-9")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"name": "a b", "runs": 1, "arms": {"ours": {}}}, "name: "),
        ({"name": "a", "runs": 1, "arms": {"ours": {"sed": 1}}}, "sed: Extra inputs"),
        ({"name": "a", "runs": 1, "arms": {"ours": {}}, "faults": {"x": "pid"}}, "expected LEVEL:TARGET"),
        ({"name": "a", "runs": 1, "arms": {"ours": {}}, "faults": {"x": {"target": 1}}}, "faults: target"),
        ({"runs": 1, "arms": {"ours": {}}}, "name: Field required"),
    ],
)
def test_bad_input_is_one_line(given: dict[str, Any], said: str) -> None:
    with pytest.raises(zenfi.BadSpecError, match=said) as refused:
        zenfi.Campaign(**given)
    assert "\n" not in str(refused.value)


def test_a_preset_or_a_file_is_scaled_and_has_no_fields_beside_it() -> None:
    assert zenfi.Campaign("demo", scale=0.5).spec.runs == zenfi.Campaign("demo").spec.runs // 2
    with pytest.raises(zenfi.BadSpecError, match="no preset of that name"):
        zenfi.Campaign("nonsense")
    with pytest.raises(zenfi.BadSpecError, match="runs: a campaign is a file"):
        zenfi.Campaign("demo", runs=3)
