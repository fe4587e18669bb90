"""Campaigns, runs and results over HTTP, of a service that flies nothing."""

import io
from collections.abc import AsyncIterator

import pytest
from fastapi import FastAPI
from pyarrow import parquet

from dashboard.campaigns.presets import presets
from dashboard.campaigns.spec import Arm, CampaignSpec
from dashboard.campaigns.store.store import Store
from services.models.faults.specification import FaultSpec
from tests.dashboard.api.asking import CAMPAIGNS, ask, make
from tests.dashboard.campaigns.store.test_store import flown

SPEC = {"name": "x", "runs": 3, "arms": [{"name": "a"}, {"name": "b", "fault": {"target": "pid"}}]}


@pytest.fixture
def app(store: Store) -> FastAPI:
    """With one campaign of six runs, of which one is flown."""
    spec = CampaignSpec(name="x", runs=3, arms=(Arm(name="a"), Arm(name="b", fault=FaultSpec(target="pid"))))
    flown(store, store.create(spec), 1)
    return make(store)


def test_what_is_wrong_is_told_with_its_field(app: FastAPI, store: Store) -> None:
    for body, field in (
        ({"spec": {**SPEC, "runs": 0}}, "spec.runs"),
        (
            {"spec": {**SPEC, "arms": [{"name": "a", "mission": {"planner": 3}}]}},
            "spec.arms.0.mission.planner",
        ),
        ({"spec": {**SPEC, "world": "sparse"}}, "spec.world"),
        ({}, "body"),
    ):
        answer = ask(app, CAMPAIGNS, "POST", json=body)
        assert answer.status_code == 422
        assert answer.headers["content-type"] == "application/problem+json"
        assert answer.json()["errors"][0]["field"] == field
    for arm, words in (({"planner": "best"}, "arms: a: unknown planner"), ({"world": "../x"}, "")):
        answer = ask(app, CAMPAIGNS, "POST", json={"spec": {**SPEC, "arms": [{"name": "a", "mission": arm}]}})
        assert answer.status_code == 422
        assert words in answer.json()["detail"]
    for preset in ("nowhere", "../presets/demo", "/etc/passwd", "pyproject.toml"):
        answer = ask(app, CAMPAIGNS, "POST", json={"preset": preset})
        assert (answer.status_code, "known: demo" in answer.json()["detail"]) == (422, True)
    assert len(store.campaigns()) == 1


def test_nothing_outside_is_read_or_connected_to(app: FastAPI, store: Store) -> None:
    trained = {"scheme": "gaussian", "model": "/etc/passwd"}
    for asked, field in (
        ({"executor": {"kind": "dask", "address": "tcp://127.0.0.1:8786"}}, "executor: 'dask'"),
        ({"executor": {"kind": "slurm", "folder": "/tmp"}}, "executor: 'slurm'"),  # noqa: S108 - refused
        ({"mission": {"detector": trained}}, "spec.mission.detector.model"),
        ({"arms": [{"name": "a", "mission": {"detector": trained}}]}, "mission.detector.model"),
        ({"mission": {"detector": {"scheme": "../models/gaussian"}}}, "unknown detector"),
        ({"artefacts": "../.."}, "spec.artefacts"),
    ):
        answer = ask(app, CAMPAIGNS, "POST", json={"spec": {**SPEC, **asked}})
        assert (answer.status_code, field in answer.json()["detail"]) == (422, True), answer.json()["detail"]
    assert len(store.campaigns()) == 1
    local = {"executor": {"kind": "local"}, "mission": {"detector": {"scheme": "gaussian"}}}
    assert ask(app, CAMPAIGNS, "POST", json={"spec": {**SPEC, **local}}).status_code == 201


def test_a_folder_that_cannot_be_made_or_is_another_campaigns_is_refused(app: FastAPI, store: Store) -> None:
    refused = (
        "x" * 5000,
        "x" * 256,
        "\u00e9" * 128,
        "/".join("x" * 600),
        "a\nb",
        "a\x7fb",
        "x-1",
        "mine/x-7/y",
    )
    for name in refused:
        answer = ask(app, CAMPAIGNS, "POST", json={"spec": {**SPEC, "artefacts": name}})
        assert (answer.status_code, "artefacts: " in answer.json()["detail"]) == (422, True), name
        assert "\n" not in answer.json()["detail"]
        assert len(answer.json()["detail"]) < 200
    assert len(store.campaigns()) == 1
    for name in ("x" * 255, "\u00e9" * 127, "mine/of today", "x-1-y", "2024-11-22b"):
        answer = ask(app, CAMPAIGNS, "POST", json={"spec": {**SPEC, "artefacts": name}})
        assert answer.status_code == 201, name
        assert store.artefacts(store.find(answer.json()["campaign"])).is_dir()


def test_a_request_that_is_sent_again_makes_nothing_new(app: FastAPI, store: Store) -> None:
    def create(body: object, key: str) -> tuple[int, str]:
        answer = ask(app, CAMPAIGNS, "POST", json=body, headers={"Idempotency-Key": key})
        return answer.status_code, answer.json().get("campaign", "")

    assert create({"spec": SPEC}, "k") == (201, "x-2")
    assert create({"spec": SPEC}, "k") == (200, "x-2")
    assert create({"spec": {**SPEC, "runs": 4}}, "k") == (422, "")
    status, other = create({"spec": SPEC}, "other")
    assert status == 201
    assert [one.label for one in store.to_be_flown()] == ["x-2", other]
    assert ask(app, f"{CAMPAIGNS}/x-2", "DELETE").status_code == 204
    assert [one.label for one in store.to_be_flown()] == [other]
    assert create({"spec": SPEC}, "k")[0] == 201


def test_presets_are_flown_at_a_scale(app: FastAPI) -> None:
    made = ask(app, CAMPAIGNS, "POST", json={"preset": "demo", "scale": 0.5}).json()
    assert (made["spec"]["name"], made["spec"]["runs"]) == ("demo", 3)
    told = ask(app, "/api/v1/presets").json()
    assert [(one["name"], one["about"]) for one in told] == [tuple(one) for one in presets()]


def test_a_campaign_is_steered(app: FastAPI, store: Store) -> None:
    def steer(what: str, method: str = "POST") -> int:
        return ask(app, f"{CAMPAIGNS}/x-1{what}", method).status_code

    assert steer("/resume") == 202
    assert [one.label for one in store.to_be_flown()] == ["x-1"]
    assert steer("/pause") == 202
    assert store.to_be_flown() == []
    assert store.find("x-1").phase == "paused", "nobody flies it"
    assert steer("/clone") == 201
    assert store.find("x-2").spec == store.find("x-1").spec
    assert steer("/cancel") == 202
    assert store.find("x-1").phase == "cancelled"
    assert [steer(what) for what in ("/cancel", "/pause", "/resume")] == [409] * 3
    with store.lock(store.find("x-1")):
        assert steer("", "DELETE") == 409
    assert steer("", "DELETE") == 204
    assert steer("", "GET") == 404


def test_a_campaign_that_waits_for_its_turn_is_paused_and_flown_later(app: FastAPI, store: Store) -> None:
    label = ask(app, CAMPAIGNS, "POST", json={"spec": SPEC}).json()["campaign"]
    told = [ask(app, f"{CAMPAIGNS}/{label}/{what}", "POST").json()["phase"] for what in ("pause", "pause")]
    assert told == ["paused", "paused"]
    assert store.to_be_flown() == []
    assert store.states(store.find(label)).count("queued") == store.progress(store.find(label)).total()
    resumed = ask(app, f"{CAMPAIGNS}/{label}/resume", "POST")
    assert (resumed.status_code, resumed.json()["phase"], resumed.json()["reason"]) == (202, "queued", "")
    assert [one.label for one in store.to_be_flown()] == [label]
    assert ask(app, f"{CAMPAIGNS}/{label}/pause", "POST").json()["phase"] == "paused"


def test_runs_come_in_pages_that_neither_repeat_nor_leave_out(app: FastAPI) -> None:
    for asked in ("", "descending=true", "sort=energy_kj", "sort=flight_time_s&descending=true", "sort=seed"):
        found: list[int] = []
        after = ""
        while True:
            page = ask(app, f"{CAMPAIGNS}/x-1/runs?limit=1&{asked}{after}").json()
            found += [run["id"] for run in page["runs"]]
            if page["next"] is None:
                break
            after = f"&after={page['next']}"
        assert sorted(found) == [1, 2, 3, 4, 5, 6], asked
        assert found[0] == (6 if asked == "descending=true" else 1), "what is flown comes first"
    assert ask(app, f"{CAMPAIGNS}/x-1/runs?after=nonsense").status_code == 422


def test_runs_are_filtered(app: FastAPI) -> None:
    for asked, found in (
        ("arm=b", [2, 4, 6]),
        ("phase=done", [1]),
        ("node_result=sdc", [1]),
        ("result=success", []),
        ("arm=b&phase=queued", [2, 4, 6]),
    ):
        runs = ask(app, f"{CAMPAIGNS}/x-1/runs?{asked}").json()["runs"]
        assert [run["id"] for run in runs] == found, asked
    assert ask(app, f"{CAMPAIGNS}/x-1/runs?pahse=done").status_code == 422


def test_one_run_is_read_in_full(app: FastAPI) -> None:
    run = ask(app, f"{CAMPAIGNS}/x-1/runs/1").json()
    assert run["outcome"]["injection"]["status"] == "injected"
    assert ask(app, f"{CAMPAIGNS}/x-1/runs/1/injection").json() == run["outcome"]["injection"]
    assert ask(app, f"{CAMPAIGNS}/x-1/runs/2/outcome").status_code == 404
    assert ask(app, f"{CAMPAIGNS}/x-1/runs/99").status_code == 404


def test_tables_come_as_json_csv_and_parquet(app: FastAPI) -> None:
    table = ask(app, f"{CAMPAIGNS}/x-1/table").json()
    assert [(line["arm"], line["runs"], line["results"]) for line in table["summary"]] == [
        ("a", 1, {"sdc": 1}),
        ("b", 0, {}),
    ]
    header, line, _ = ask(app, f"{CAMPAIGNS}/x-1/table?format=csv").text.splitlines()
    told = dict(zip(header.split(","), line.split(","), strict=True))
    assert (told["arm"], told["sdc"], told["crash"]) == ("a", "1", "0")
    assert float(told["success_high"]) == table["summary"][0]["success_high"]
    read = parquet.read_table(io.BytesIO(ask(app, f"{CAMPAIGNS}/x-1/table?format=parquet").content))
    assert read.column("sdc").to_pylist() == [1, 0]
    runs = parquet.read_table(io.BytesIO(ask(app, f"{CAMPAIGNS}/x-1/export?format=parquet").content))
    assert runs.column("phase").to_pylist() == ["done"] + ["queued"] * 5


def test_files_are_read_in_ranges_and_none_from_outside(app: FastAPI, store: Store) -> None:
    folder = store.artefacts(store.find("x-1"))
    (folder / "worker-0.log").write_text("0123456789")
    (folder / "out").symlink_to(store.folder / "zenfi.sqlite")
    path = f"{CAMPAIGNS}/x-1/artefacts"
    assert ask(app, path).json() == [{"path": "worker-0.log", "bytes": 10}]
    part = ask(app, f"{path}/worker-0.log", headers={"Range": "bytes=2-4"})
    assert (part.status_code, part.text) == (206, "234")
    for outside in ("out", "../../zenfi.sqlite", "%2e%2e/%2e%2e/zenfi.sqlite", "nothing"):
        assert ask(app, f"{path}/{outside}").status_code == 404, outside


def test_a_body_that_is_too_large_is_refused(app: FastAPI) -> None:
    async def pieces() -> AsyncIterator[bytes]:
        for _ in range(30):
            yield b" " * 100_000

    for body in (b" " * 3_000_000, pieces()):
        answer = ask(app, CAMPAIGNS, "POST", content=body, headers={"Content-Type": "application/json"})
        assert answer.status_code == 413
        assert answer.headers["content-type"] == "application/problem+json"


def test_metrics_count_what_is_there(app: FastAPI) -> None:
    ask(app, f"{CAMPAIGNS}/nothing")
    told = ask(app, "/metrics").text
    assert 'zenfi_runs{phase="done"} 1.0' in told
    assert 'zenfi_campaigns{phase="running"} 1.0' in told
    assert 'route="/campaigns/{label}",status="404"} 1.0' in told


def test_a_broken_store_makes_the_service_unready(store: Store) -> None:
    assert ask(make(store), "/ready").status_code == 503
