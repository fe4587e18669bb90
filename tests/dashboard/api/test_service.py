"""The real service, from another process: with curl alone, through crashes, to a clean end."""

import csv
import io
import json
import os
import signal
import subprocess
from contextlib import closing
from pathlib import Path

import httpx
import pytest

from dashboard.campaigns.spec import Arm, CampaignSpec, RecordingPolicy
from dashboard.campaigns.store.store import Store
from dashboard.client import Client, RequestRefusedError
from services.models.faults.specification import FaultSpec
from services.models.mission import Limits, MissionSpec
from services.models.outcome import Outcome
from tests.conftest import alive, descendants, folders, wait_until
from tests.dashboard.api.conftest import PATIENCE_S, Serving, serving
from tests.dashboard.campaigns.test_durability import done, told
from tests.fixtures.postgresql import PASSWORD, Server

SPEC = CampaignSpec(
    name="short",
    runs=3,
    mission=MissionSpec(limits=Limits(mission_time_s=0.6)),
    arms=(Arm(name="golden"), Arm(name="flip", fault=FaultSpec(target="pid"))),
)


def curl(*arguments: str) -> str:
    command = ["curl", "--silent", "--show-error", "--fail-with-body", "--max-time", str(PATIENCE_S)]
    return subprocess.run([*command, *arguments], capture_output=True, check=True, text=True).stdout


@pytest.mark.soak
def test_curl_alone_starts_watches_and_reads_a_campaign(service: Serving) -> None:
    api = f"{service.address}/api/v1"
    body = json.dumps({"spec": SPEC.model_dump(mode="json", exclude_unset=True)})
    made = json.loads(curl(f"{api}/campaigns", "--json", body))
    label = made["campaign"]

    events = curl("--no-buffer", f"{api}/campaigns/{label}/events").split("\n\n")
    kinds = [line.removeprefix("event: ") for event in events for line in event.split("\n")[:1]]
    assert kinds.count("run") == 6
    assert {"campaign", "run", "process"} <= set(kinds)
    last = json.loads(next(line for line in events[-2].split("\n") if line.startswith("data: "))[6:])
    assert (last["phase"], last["done"]) == ("done", 6)

    golden, flip = json.loads(curl(f"{api}/campaigns/{label}/table"))["summary"]
    assert (golden["arm"], golden["runs"], golden["aimed"]) == ("golden", 3, 0)
    assert (flip["arm"], flip["runs"], flip["aimed"]) == ("flip", 3, 3)
    rows = list(csv.DictReader(io.StringIO(curl(f"{api}/campaigns/{label}/export?format=csv"))))
    assert [row["arm"] for row in rows] == ["golden", "flip"] * 3
    assert {row["result"] for row in rows} == {"timeout"}


@pytest.mark.soak
def test_poses_of_flights_that_are_under_way_are_told(client: Client) -> None:
    longer = SPEC.model_copy(update={"mission": MissionSpec(limits=Limits(mission_time_s=5)), "runs": 1})
    made = client.campaigns.create(longer)
    flights = [event.data for event in client.watch(made.campaign) if event.kind == "flight"]
    assert flights
    assert {flight.campaign for flight in flights} == {made.campaign}
    assert flights[0].present.position_m[2] > 1.0


@pytest.mark.soak
def test_killed_in_mid_campaign_it_goes_on_to_the_same_results(tmp_path: Path) -> None:
    calm, hard = tmp_path / "calm", tmp_path / "hard"
    with serving(calm) as one, Client(one.address) as client:
        assert list(client.watch(client.campaigns.create(SPEC).campaign))[-1].data.phase == "done"

    with serving(hard) as one, Client(one.address) as client:
        client.campaigns.create(SPEC)
        wait_until(lambda: done(hard) >= 2, PATIENCE_S)
        family = descendants(one.process.pid)
        one.kill()
    wait_until(lambda: not any(map(alive, family)))
    before = done(hard)
    with serving(hard) as one, Client(one.address) as client:
        assert list(client.watch("short-1"))[-1].data.phase == "done"
    assert before < 6 == done(hard)
    with closing(Store(calm)) as undisturbed, closing(Store(hard)) as killed:
        ours, theirs = (list(store.records(store.find("1"))) for store in (killed, undisturbed))
    assert [told(record) for record in ours] == [told(record) for record in theirs]


@pytest.mark.soak
def test_the_service_survives_its_pilot_and_starts_another(tmp_path: Path) -> None:
    with serving(tmp_path) as one, Client(one.address) as client:
        label = client.campaigns.create(SPEC).campaign
        pilots = []
        for event in client.watch(label):
            if event.kind == "process" and event.data.state == "running":
                pilots.append(event.data.pid)
                if len(pilots) == 1:
                    os.kill(event.data.pid, signal.SIGKILL)
        assert len(pilots) == 2
        assert client.campaigns.get(label).done == 6


def test_nothing_is_accepted_into_a_store_whose_file_is_gone(tmp_path: Path) -> None:
    store = tmp_path / "zenfi.sqlite"
    with serving(tmp_path) as one, Client(one.address) as client:
        kept = client.campaigns.create(SPEC.model_copy(update={"name": "kept"})).campaign
        client.campaigns.command(kept, "cancel")
        store.rename(tmp_path / "away")
        with pytest.raises(RequestRefusedError, match="removed or replaced") as refused:
            client.campaigns.create(SPEC)
        assert refused.value.problem.status == 503
        assert httpx.get(f"{one.address}/ready").status_code == 503
        (tmp_path / "away").rename(store)
        assert httpx.get(f"{one.address}/ready").status_code == 200
        label = client.campaigns.create(SPEC).campaign
        assert [line.campaign for line in client.campaigns.all()] == [label, kept]


@pytest.mark.soak
def test_told_to_end_it_keeps_what_is_finished_and_ends_its_streams(tmp_path: Path) -> None:
    with serving(tmp_path) as one, Client(one.address) as client:
        client.campaigns.create(SPEC.model_copy(update={"runs": 500}))
        watching = ["curl", "--silent", "--no-buffer", f"{one.address}/api/v1/events"]
        stream = subprocess.Popen(watching, stdout=subprocess.PIPE)
        wait_until(lambda: done(tmp_path) >= 2, PATIENCE_S)
        family = descendants(one.process.pid)
        one.process.send_signal(signal.SIGTERM)
        assert one.process.wait(PATIENCE_S) == 0
        said, _ = stream.communicate(timeout=PATIENCE_S)
    assert b"event: run" in said
    wait_until(lambda: not any(map(alive, family)))
    assert not any(folders(pid) for pid in family)
    with closing(Store(tmp_path)) as store:
        found = store.find("short-1")
        assert (found.phase, found.reason) == ("paused", "the service stopped")
        assert store.to_be_flown() == [found]
        assert store.progress(found)["done"] >= 2
        assert store.states(found).count("leased", "running") == 0


@pytest.mark.soak
def test_on_postgresql_it_flies_and_tells_no_password(tmp_path: Path, postgresql_server: Server) -> None:
    url = postgresql_server.database()
    with serving(tmp_path, store=url) as one, Client(one.address) as client:
        made = client.campaigns.create(SPEC)
        seen: set[str] = set()
        for event in client.watch(made.campaign):
            if event.kind == "process" and event.data.state == "running":
                seen.add(Path(f"/proc/{event.data.pid}/cmdline").read_text())
        assert client.campaigns.get(made.campaign).done == 6
        assert "worker-0.log" in {artefact.path for artefact in client.campaigns.artefacts(made.campaign)}
        with pytest.raises(RequestRefusedError) as refused:
            client.campaigns.get("short-99")
    assert seen
    assert not any(PASSWORD in told for told in (*seen, one.said.read_text(), str(refused.value)))


@pytest.mark.soak
def test_a_campaign_keeps_files_and_the_service_serves_them(client: Client) -> None:
    kept = SPEC.model_copy(update={"recording": RecordingPolicy(keep="all"), "artefacts": "mine", "runs": 1})
    made = client.campaigns.create(kept)
    assert list(client.watch(made.campaign))[-1].data.phase == "done"
    assert client.campaigns.get(made.campaign).files["kept"].runs == 2
    run = next(client.runs.all(made.campaign)).id
    paths = {artefact.path for artefact in client.campaigns.artefacts(made.campaign)}
    assert f"run-{run}.json" in paths
    read = client.campaigns.artefact(made.campaign, f"run-{run}.json")
    assert Outcome.model_validate_json(read) == client.runs.outcome(made.campaign, run)


@pytest.mark.soak
def test_a_campaign_whose_database_was_away_goes_on(tmp_path: Path, postgresql_server: Server) -> None:
    url = postgresql_server.database()
    with serving(tmp_path, store=url) as one, Client(one.address) as client:
        label = client.campaigns.create(SPEC).campaign
        wait_until(lambda: client.campaigns.get(label).done >= 1, PATIENCE_S)
        ended = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE application_name = 'zenfi'"
        postgresql_server.execute(ended)

        def is_done() -> bool:
            try:
                return client.campaigns.get(label).phase == "done"
            except RequestRefusedError as refused:
                if refused.problem.status == 503:  # who asks while it is away is told so
                    return False
                raise

        wait_until(is_done, PATIENCE_S)
        assert client.campaigns.get(label).done == 6


@pytest.mark.soak
@pytest.mark.parametrize("hindrance", ["a file in its place", "a link that leads out"])
def test_a_campaign_that_cannot_be_set_up_fails_and_the_next_one_flies(
    tmp_path: Path, hindrance: str
) -> None:
    with closing(Store(tmp_path)) as store:
        place = store.folder / "artefacts" / "taken"
        if hindrance == "a file in its place":
            place.touch()
        else:
            place.symlink_to(tmp_path.parent)
        stuck = store.create(SPEC.model_copy(update={"artefacts": "taken"}), "fly").label
        behind = store.create(SPEC.model_copy(update={"runs": 1}), "fly").label
    with serving(tmp_path) as one, Client(one.address) as client:
        assert list(client.watch(behind))[-1].data.phase == "done"
        failed = client.campaigns.get(stuck)
        assert (failed.phase, failed.failed, failed.done) == ("failed", 6, 0)
        assert "taken" in failed.reason
        assert failed.trouble == ""
        assert "\n" not in failed.reason

        place.unlink()
        client.campaigns.command(stuck, "resume")
        assert list(client.watch(stuck))[-1].data.phase == "done"
        assert client.campaigns.get(stuck).done == 6
