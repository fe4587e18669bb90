"""Studies of programs over HTTP: of programs that the owner allows, through crashes and restarts."""

import signal
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, get_args

import pytest

from dashboard.analysis.kernel_study import WAYS
from dashboard.api.processes.program_studies import FOLDER, ProgramStudies, allowed_programs
from dashboard.api.processes.study_reader import StudyReader
from dashboard.api.routes.program_studies import NewProgramStudy, ProgramStudyDetail, Way
from dashboard.campaigns.store.store import Store
from dashboard.client import Client, RequestRefusedError
from injector.kernel_study.results import StudyRun
from tests.conftest import alive, descendants, wait_until
from tests.dashboard.api.asking import ask, make
from tests.dashboard.api.conftest import PATIENCE_S, Serving, serving
from tests.dashboard.command import refusal
from zenfi import programs

API = "/api/v1"
STUDIES = f"{API}/program-studies"
HELLO = """
runs = 6
seed = 4
[program]
command = ["/bin/echo", "hello"]
environment = { SECRET = "s3cr3t" }
"""
CLOCK = '[program]\ncommand = ["date", "+%N"]\n'
LONG = 'runs = 20000\n[program]\ncommand = ["/bin/true"]\n'


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short study, one that does not end while a test runs, and one that cannot be made."""
    path = tmp_path_factory.mktemp("programs")
    (path / "clock.toml").write_text(CLOCK)
    (path / "hello.toml").write_text(HELLO)
    (path / "long.toml").write_text(LONG)
    return path


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with closing(Store(tmp_path / "store")) as opened:
        yield opened


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory, folder: Path) -> Iterator[Serving]:
    """One service for this file, whose owner allows the programs in the folder."""
    with serving(tmp_path_factory.mktemp("service"), "--programs", str(folder)) as one:
        yield one


@pytest.fixture
def client(service: Serving) -> Iterator[Client]:
    with Client(service.address) as one:
        yield one


def ended(client: Client, label: str) -> ProgramStudyDetail:
    """A study, once nobody makes it any more."""
    wait_until(lambda: client.program_studies.get(label).phase not in ("queued", "running"), PATIENCE_S)
    return client.program_studies.get(label)


def under_way(client: Client, label: str, runs: int = 3) -> None:
    """Wait until a study has made so many runs."""
    wait_until(lambda: client.program_studies.get(label).done >= runs, PATIENCE_S)


def test_without_a_folder_there_is_nothing_to_strike(store: Store) -> None:
    app = make(store)
    assert ask(app, f"{API}/programs").json() == []
    assert ask(app, STUDIES).json() == {"studies": [], "next": None}
    refused = ask(app, STUDIES, "POST", json={"program": "true"})
    assert refused.status_code == 403
    assert refused.headers["content-type"] == "application/problem+json"
    assert "'true' is no program that the service was started with: zenfi serve --programs" in refused.text
    assert not (store.folder / FOLDER).exists()


@pytest.mark.parametrize(
    ("body", "status", "problem"),
    [
        ({"program": "/bin/sh"}, 403, "'/bin/sh' is no program"),
        ({"program": "../hello"}, 403, "is no program"),
        ({"program": "hello.toml"}, 403, "is no program"),
        ({"program": "hello", "command": ["/bin/sh"]}, 422, "command: Extra inputs"),
        ({"program": "hello", "environment": {"LD_PRELOAD": "x"}}, 422, "environment: Extra inputs"),
        ({"program": "hello", "module": "x"}, 422, "module: Extra inputs"),
        ({"program": "hello", "fault": {"histogram": "/etc/passwd"}}, 422, "fault.histogram: "),
        ({"program": "hello", "fault": {"target": "pid"}}, 422, "fault.target: "),
        ({"program": "hello", "fault": {"colour": 1}}, 422, "fault.colour: "),
        ({"program": "hello", "runs": 100_001}, 422, "runs: "),
        ({"program": "hello", "runs": 0}, 422, "runs: "),
        ({"program": "hello", "seed": -1}, 422, "seed: "),
        ({"program": "hello", "slots": 2}, 422, "slots: the service has 1"),
    ],
)
def test_a_request_names_an_allowed_program_and_bounded_numbers(
    store: Store, folder: Path, body: dict[str, Any], status: int, problem: str
) -> None:
    refused = ask(make(store, allowed=allowed_programs(folder)), STUDIES, "POST", json=body)
    assert (refused.status_code, refused.headers["content-type"]) == (status, "application/problem+json")
    assert problem in refused.json()["detail"]
    assert not (store.folder / FOLDER).exists()


def test_what_is_told_of_a_program_is_not_its_environment(store: Store, folder: Path) -> None:
    app = make(store, allowed=allowed_programs(folder))
    listed = ask(app, f"{API}/programs")
    assert [(one["program"], one["command"]) for one in listed.json()] == [
        ("clock", ["date", "+%N"]),
        ("hello", ["/bin/echo", "hello"]),
        ("long", ["/bin/true"]),
    ]
    made = ask(app, STUDIES, "POST", json={"program": "hello"})
    assert made.status_code == 201
    assert made.headers["location"] == f"{STUDIES}/hello-1"
    assert "s3cr3t" not in listed.text + made.text + ask(app, f"{STUDIES}/hello-1").text


def test_a_creation_that_is_sent_again_makes_nothing_new(store: Store, folder: Path) -> None:
    app = make(store, allowed=allowed_programs(folder))

    def sent(**body: object) -> tuple[int, str]:
        answer = ask(
            app, STUDIES, "POST", json={"program": "hello", **body}, headers={"Idempotency-Key": "k"}
        )
        return answer.status_code, answer.json().get("study") or answer.json()["detail"]

    assert sent() == (201, "hello-1")
    assert sent() == (200, "hello-1")
    status, problem = sent(seed=9)
    assert (status, "has created hello-1, which is another study" in problem) == (422, True)
    assert len(ask(app, STUDIES).json()["studies"]) == 1


def test_the_list_has_pages_and_numbers_are_not_given_again(store: Store, folder: Path) -> None:
    app = make(store, allowed=allowed_programs(folder))
    for name in ("hello", "long", "hello"):
        ask(app, STUDIES, "POST", json={"program": name})
    first = ask(app, f"{STUDIES}?limit=2").json()
    assert [one["study"] for one in first["studies"]] == ["hello-3", "long-2"]
    rest = ask(app, f"{STUDIES}?limit=2&before={first['next']}").json()
    assert ([one["study"] for one in rest["studies"]], rest["next"]) == (["hello-1"], None)
    assert ask(app, f"{STUDIES}/hello-3", "DELETE").status_code == 409
    assert ask(app, f"{STUDIES}/hello-3/cancel", "POST").json()["phase"] == "cancelled"
    assert ask(app, f"{STUDIES}/hello-3/resume", "POST").status_code == 409
    assert ask(app, f"{STUDIES}/hello-3", "DELETE").status_code == 204
    assert ask(app, f"{STUDIES}/hello-3").status_code == 404
    assert ask(app, STUDIES, "POST", json={"program": "hello"}).json()["study"] == "hello-4"
    for label in ("..", "changes.lock", "hello-1%2f..%2flong-2", "none-7"):
        assert ask(app, f"{STUDIES}/{label}/runs").status_code == 404


def test_a_study_over_http_is_the_study_of_the_command(client: Client, folder: Path, tmp_path: Path) -> None:
    label = client.program_studies.create(NewProgramStudy(program="hello", slots=1)).study
    made = ended(client, label)
    assert (made.phase, made.reason, made.runs, made.done) == ("done", "", 6, 6)
    here = programs.make(programs.load(folder / "hello.toml"), slots=1, progress=False)
    assert made.summary is not None
    assert made.summary.model_dump() == here.summary.model_dump(exclude={"per_second", "cpu_ms"})
    assert list(client.program_studies.runs(label, limit=4)) == here.runs
    harmful = [one for one in here.runs if one.result == "crash"]
    assert list(client.program_studies.runs(label, "crash")) == harmful
    for way in WAYS:
        told = client.program_studies.breakdown(label, way)  # type: ignore[arg-type]
        assert [(one.name, one.injected, one.shares) for one in told.groups] == here.by(way)
    kept = tmp_path / "kept.jsonl"
    kept.write_bytes(client.program_studies.file(label))
    assert all(one.same for one in programs.replay(kept, [0, 1], slots=1))
    client.program_studies.delete(label)
    assert label not in {one.study for one in client.program_studies.all()}


def test_the_ways_over_http_are_those_that_there_are() -> None:
    assert get_args(Way) == tuple(WAYS)


@pytest.mark.soak
def test_a_study_is_paused_goes_on_and_is_cancelled(client: Client) -> None:
    label = client.program_studies.create(NewProgramStudy(program="long")).study
    under_way(client, label)
    assert client.program_studies.get(label).phase == "running"
    with pytest.raises(RequestRefusedError, match="cancel or pause it first"):
        client.program_studies.delete(label)
    assert client.program_studies.command(label, "pause").phase == "paused"
    wait_until(lambda: not struck(client), PATIENCE_S)
    before = client.program_studies.get(label).done
    client.program_studies.command(label, "resume")
    under_way(client, label, before + 1)
    client.program_studies.command(label, "cancel")
    wait_until(lambda: not struck(client), PATIENCE_S)
    kept = client.program_studies.get(label)
    assert (kept.phase, kept.reason) == ("cancelled", "cancelled")
    assert kept.done > before
    client.program_studies.delete(label)


def struck(client: Client) -> list[str]:
    """The processes of the service that make studies or strike."""
    return [one.name for one in client.processes().service if "program" in one.name]


def test_a_program_that_cannot_be_struck_says_why(client: Client) -> None:
    made = ended(client, client.program_studies.create(NewProgramStudy(program="clock", slots=1)).study)
    assert made.phase == "failed"
    assert "date: its output is not the same in each run" in made.reason
    assert made.summary is None


def test_killed_it_leaves_nothing_and_the_next_life_goes_on(tmp_path: Path, folder: Path) -> None:
    store = tmp_path / "store"
    runs = store / FOLDER / "long-1" / "runs.jsonl"
    with serving(store, "--programs", str(folder)) as one, Client(one.address) as client:
        client.program_studies.create(NewProgramStudy(program="long"))
        under_way(client, "long-1")
        family = descendants(one.process.pid)
        assert len(family) >= 3  # the process of the study, a worker, what launches programs
        one.kill()
    wait_until(lambda: not any(map(alive, family)), PATIENCE_S)
    kept = runs.read_bytes()[: runs.read_bytes().rfind(b"\n") + 1]

    with serving(store, "--programs", str(folder)) as one, Client(one.address) as client:
        under_way(client, "long-1", kept.count(b"\n"))
        one.process.send_signal(signal.SIGTERM)
        assert one.process.wait(PATIENCE_S) == 0
    assert runs.read_bytes().startswith(kept)
    assert [one.phase for one in ProgramStudies(store / FOLDER, {}).entries()] == ["queued"]
    assert all(one.same for one in programs.replay(runs, [one.index for one in _first(runs)], slots=1))


def _first(runs: Path) -> list[StudyRun]:
    return StudyReader(runs).page(-1, 2, None)[0]


def test_what_is_no_longer_allowed_is_not_gone_on_with(tmp_path: Path, folder: Path) -> None:
    studies = ProgramStudies(tmp_path / FOLDER, allowed_programs(folder))
    studies.create("hello", studies.allowed["hello"], None, "")
    with serving(tmp_path) as one, Client(one.address) as client:
        halted = ended(client, "hello-1")
        assert (halted.phase, halted.done) == ("paused", 0)
        assert "no longer a program that may be struck" in halted.reason
        with pytest.raises(RequestRefusedError, match="--programs FOLDER") as refused:
            client.program_studies.command("hello-1", "resume")
        assert refused.value.problem.status == 403


def test_a_folder_of_programs_that_is_none_is_one_line(tmp_path: Path) -> None:
    assert "no such folder" in refusal("serve", "--programs", tmp_path / "nowhere")
    (tmp_path / "bad.toml").write_text('[program]\ncommand = ["true"]\nshell = "x"\n')
    assert "bad.toml: program.shell: Extra inputs" in refusal("serve", "--programs", tmp_path)
    (tmp_path / "bad.toml").rename(tmp_path / "b d.toml")
    assert "call it by letters" in refusal("serve", "--programs", tmp_path)
