"""Nobody has the service run a program that its owner has not named when starting it."""

import hashlib
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI

from dashboard.campaigns.spec import Arm, CampaignSpec
from dashboard.campaigns.store.store import Store
from dashboard.client import Client, RequestRefusedError
from services.models.mission import Limits, MissionSpec
from services.models.own_stack import OwnStack
from tests.dashboard.api.asking import CAMPAIGNS, ask, make
from tests.dashboard.api.conftest import serving
from tests.dashboard.command import refusal
from tests.fixtures.own_stacks import scripted

SHELL = Path("/bin/sh").resolve()
REMEDY = "zenfi serve --allow-stack FILE"
HOVERS = """
for words, body in lines():
    if words[0] == b"zenfi":
        say("ready")
    elif words[0] == b"step":
        say(f"put command {len(TWIST)}", TWIST)
        say("done")
"""


def attack(canary: Path) -> dict[str, Any]:
    """A stack whose control is a shell, complete with its digest."""
    control = {
        "command": [str(SHELL), "-c", f"id > {canary}"],
        "folder": "/",
        "sha256": hashlib.sha256(SHELL.read_bytes()).hexdigest(),
        "latency": {"mean_ms": 1.0},
    }
    return {"name": "evil", "stages": {"control": control}}


def asked(stack: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """Every request that makes or reckons a flight, with the stack in every place that has one."""
    mission, fields = {"stack": stack}, {"name": "x", "runs": 1}
    of_mission = {"spec": {**fields, "mission": mission, "arms": [{"name": "a"}]}}
    of_arm = {"spec": {**fields, "arms": [{"name": "a"}, {"name": "b", "mission": mission}]}}
    return [
        ("/api/v1/flights", {"mission": mission}),
        *((path, body) for path in (CAMPAIGNS, f"{CAMPAIGNS}/forecast") for body in (of_mission, of_arm)),
    ]


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with closing(Store(tmp_path / "store")) as opened:
        yield opened


@pytest.fixture
def app(store: Store) -> FastAPI:
    return make(store)


def test_no_request_names_a_program(app: FastAPI, store: Store, tmp_path: Path) -> None:
    for path, body in asked(attack(tmp_path / "canary")):
        answer = ask(app, path, "POST", json=body)
        assert answer.status_code == 403, path
        assert answer.headers["content-type"] == "application/problem+json"
        assert str(SHELL) in answer.json()["detail"]
        assert REMEDY in answer.json()["detail"]
    assert store.campaigns() == []


def test_no_file_is_looked_at_for_who_may_not_name_it(app: FastAPI, tmp_path: Path) -> None:
    told = set()
    for file in ("/etc/shadow", "/etc", "/nowhere"):
        stack = attack(tmp_path)
        stack["stages"]["control"]["command"] = [file]
        answer = ask(app, "/api/v1/flights", "POST", json={"mission": {"stack": stack}})
        told.add((answer.status_code, answer.json()["detail"].replace(file, "FILE")))
    assert len(told) == 1, told


def test_what_the_owner_has_stored_is_not_copied_for_others(
    app: FastAPI, store: Store, tmp_path: Path
) -> None:
    mission = MissionSpec(stack=OwnStack.model_validate(attack(tmp_path / "canary")))
    store.create(CampaignSpec(name="own", runs=2, mission=mission, arms=(Arm(name="a"),)))
    assert ask(app, f"{CAMPAIGNS}/own-1/clone", "POST").status_code == 403
    assert ask(app, f"{CAMPAIGNS}/own-1/resume", "POST").status_code == 202
    assert [one.label for one in store.campaigns()] == ["own-1"]


def test_what_the_owner_has_named_is_flown_and_nothing_else(tmp_path: Path) -> None:
    canary = tmp_path / "canary"
    stack = scripted(tmp_path, HOVERS)
    mission = MissionSpec(stack=stack, limits=Limits(mission_time_s=0.6))
    served = serving(tmp_path / "store", "--allow-stack", str(tmp_path / "stack.toml"))
    with served as one, Client(one.address) as client:
        flight = client.flights.create(mission).campaign.campaign
        assert list(client.watch(flight))[-1].data.phase == "done"
        assert client.runs.outcome(flight, client.flights.get(flight).run.id).nodes["control"].steps > 0

        own = stack.stages["control"]
        for change in (
            {"command": (*own.command, "--more")},
            {"command": (own.command[0], "-c", f"open({str(canary)!r}, 'w')")},
            {"folder": "/"},
            {"sha256": "0" * 64},
        ):
            other = OwnStack(name="x", stages={"control": own.model_copy(update=change)})
            with pytest.raises(RequestRefusedError, match=REMEDY) as refused:
                client.flights.create(mission.model_copy(update={"stack": other}))
            assert refused.value.problem.status == 403

        (tmp_path / "script.py").write_text("print('something else')")
        with pytest.raises(RequestRefusedError, match="is not what it was") as changed:
            client.flights.create(mission.model_copy(update={"seed": 1}))
        assert changed.value.problem.status == 422
    assert not canary.exists()


def test_a_named_stack_that_is_none_is_one_line(tmp_path: Path) -> None:
    assert "nowhere.toml: No such file" in refusal("serve", "--allow-stack", tmp_path / "nowhere.toml")
    (tmp_path / "bad.toml").write_text("stages = 3")
    assert "bad.toml: stack" in refusal("serve", "--allow-stack", tmp_path / "bad.toml")
