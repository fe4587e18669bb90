"""``zenfi replay`` reads what our own commands wrote, and says what it passes over and what it refuses."""

import json
from contextlib import closing
from pathlib import Path

import pytest

from dashboard.campaigns.spec import load_campaign
from dashboard.campaigns.store.listing import RunQuery, run_page, stored_run
from dashboard.campaigns.store.store import Store
from tests.dashboard.command import Answer, refusal, zenfi

SPEC = """
name = "small"
runs = 1
mission = { seed = 7, limits = { mission_time_s = 6.0 } }
[[arms]]
name = "golden"
[[arms]]
name = "pid"
fault = { target = "pid", register_class = "vector", seed = 2 }
"""


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A store with a small campaign, and what `campaign run --json` printed of it."""
    folder = tmp_path_factory.mktemp("flown")
    (folder / "small.toml").write_text(SPEC)
    answer = zenfi("campaign", "run", folder / "small.toml", "--store", folder, "--slots", 1, "--json")
    assert answer.returncode == 0, answer.stderr
    return folder, answer.stdout


def replayed(file: Path) -> Answer:
    """The answer for a file with the one injected flight."""
    answer = zenfi("replay", file, "--json")
    assert [json.loads(line)["answer"] for line in answer.stdout.splitlines()] == ["replayed"], answer.stderr
    assert answer.returncode == 0
    return answer


def test_what_campaign_run_printed_is_replayed_and_other_lines_are_counted(
    flown: tuple[Path, str], tmp_path: Path
) -> None:
    told = [json.loads(line) for line in flown[1].splitlines()]
    assert "forecast" in told[0]
    assert "summary" in told[-1]
    (tmp_path / "runs.jsonl").write_text(flown[1])
    answer = replayed(tmp_path / "runs.jsonl")
    assert answer.stderr == "passed over: 3 (1 forecast, 1 golden, 1 summary)\n"


def test_a_campaign_of_the_store_is_replayed_by_its_label(flown: tuple[Path, str]) -> None:
    answer = zenfi("replay", "small-1", "--store", flown[0])
    assert (answer.returncode, answer.stderr) == (0, "passed over: 1 (1 golden)\n")
    (row,) = [line.split() for line in answer.stdout.splitlines() if line.split()[:1] == ["pid"]]
    assert row == ["pid", "1", "1", "0", "0", "0"]
    shown = zenfi("campaign", "show", "small-1", "--store", flown[0])
    assert "1 flown again, 1 replayed" in shown.stderr + shown.stdout
    told = json.loads(
        zenfi("campaign", "show", "small-1", "--store", flown[0], "--json").stdout.splitlines()[0]
    )
    assert told["replays"] == {"replayed": 1}


def test_one_run_of_a_campaign_is_replayed(flown: tuple[Path, str]) -> None:
    told = [json.loads(line) for line in flown[1].splitlines()]
    with closing(Store(flown[0])) as store:
        ids = {one.arm: one.id for one in run_page(store, store.find("1"), RunQuery()).runs}
    assert "small-1" in {one["campaign"] for one in told}
    answer = zenfi("replay", f"small-1/{ids['pid']}", "--store", flown[0], "--json")
    assert [json.loads(line)["answer"] for line in answer.stdout.splitlines()] == ["replayed"], answer.stderr
    says = refusal("replay", f"small-1/{ids['golden']}", "--store", flown[0])
    assert says.endswith("no flight with a fault to replay")
    assert "no run '77'" in refusal("replay", "small-1/77", "--store", flown[0])
    assert "no campaign 'large-1'" in refusal("replay", "large-1", "--store", flown[0])


@pytest.mark.soak
def test_what_campaign_resume_printed_is_replayed(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SPEC)
    with closing(Store(tmp_path)) as store:
        label = store.create(load_campaign(str(tmp_path / "small.toml"))).label
    printed = zenfi("campaign", "resume", label, "--store", tmp_path, "--slots", 1, "--json").stdout
    (tmp_path / "runs.jsonl").write_text(printed)
    assert "(1 golden, 1 summary)" in replayed(tmp_path / "runs.jsonl").stderr


@pytest.mark.soak
def test_what_fly_printed_is_replayed(tmp_path: Path) -> None:
    printed = zenfi("fly", "--seed", 7, "--fault", "instruction:pid", "--json").stdout
    (tmp_path / "flight.json").write_text(printed)
    assert replayed(tmp_path / "flight.json").stderr == ""


def test_what_the_service_tells_of_runs_is_replayed(flown: tuple[Path, str], tmp_path: Path) -> None:
    with closing(Store(flown[0])) as store:
        found = store.find("1")
        runs = [stored_run(store, found, one.id) for one in run_page(store, found, RunQuery()).runs]
    lines = [one.model_dump_json(by_alias=True) for one in runs if one is not None]
    waiting = json.dumps(json.loads(lines[0]) | {"outcome": None})
    (tmp_path / "runs.jsonl").write_text("\n".join([*lines, waiting]))
    assert "(1 golden, 1 not flown)" in replayed(tmp_path / "runs.jsonl").stderr


def test_runs_that_were_not_flown_and_faults_that_struck_nowhere_are_passed_over(
    flown: tuple[Path, str], tmp_path: Path
) -> None:
    struck = next(line for line in flown[1].splitlines() if '"injection": {' in line)
    nowhere = json.loads(struck)
    nowhere["outcome"]["injection"] = None
    error = {"campaign": "small-1", "arm": "pid", "index": 0, "error": "the injector died"}
    (tmp_path / "runs.jsonl").write_text("\n".join([json.dumps(error), json.dumps(nowhere), "", struck]))
    assert "2 (1 not flown, 1 not repeatable)" in replayed(tmp_path / "runs.jsonl").stderr


def test_a_file_without_an_injected_flight_is_refused(flown: tuple[Path, str], tmp_path: Path) -> None:
    (tmp_path / "runs.jsonl").write_text(flown[1].splitlines()[0])
    assert refusal("replay", tmp_path / "runs.jsonl").endswith("runs.jsonl: no flight with a fault to replay")


def test_a_flight_that_cannot_repeat_is_refused_with_the_reason(
    flown: tuple[Path, str], tmp_path: Path
) -> None:
    struck = next(line for line in flown[1].splitlines() if '"injection": {' in line)
    told = json.loads(struck)
    told["outcome"]["spec"]["clock"] = "realtime"
    (tmp_path / "runs.jsonl").write_text(json.dumps(told))
    assert "runs.jsonl: nothing to replay: a flight in real time" in refusal(
        "replay", tmp_path / "runs.jsonl"
    )


@pytest.mark.parametrize(
    ("content", "number", "says"),
    [
        (
            b'{"campaign": "small-1", "forecast": {}}\n{"campaign": "small-1", "out',
            2,
            "not a whole line of JSON",
        ),
        (b"number,seed,result\n1,7,success\n", 1, "not a whole line of JSON"),
        (b"PAR1\x15\x04\xff\xfe\n", 1, "not a whole line of JSON"),
        (b"[" * 100_000, 1, "not a whole line of JSON"),
        (b'\n{"kernel": "pid", "index": 0}', 2, "not what"),
        (b'{"summary": []}', 1, "not what"),
        (b'{"outcome": {"result": "success"}}', 1, "no outcome of a flight: spec: Field required"),
        (b"[1]", 1, "not what"),
    ],
)
def test_what_is_not_ours_or_damaged_is_refused_with_its_line(
    content: bytes, number: int, says: str, tmp_path: Path
) -> None:
    (tmp_path / "file").write_bytes(content)
    said = refusal("replay", tmp_path / "file")
    assert f"file, line {number}: " in said
    assert says in said


def test_a_specification_that_cannot_be_flown_here_is_refused_with_its_line(
    flown: tuple[Path, str], tmp_path: Path
) -> None:
    struck = next(line for line in flown[1].splitlines() if '"injection": {' in line)
    (tmp_path / "runs.jsonl").write_text(struck + "\n" + struck.replace('"rrt_star"', '"dijkstra"'))
    assert "line 2: unknown planner 'dijkstra'" in refusal("replay", tmp_path / "runs.jsonl")
