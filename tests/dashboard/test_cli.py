"""The command as people and programs meet it."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from click import Context

from dashboard.cli import COMMANDS
from dashboard.cli import zenfi as zenfi_group
from tests.conftest import PATIENCE_S, alive, descendants, folders, node, segments, wait_until
from tests.dashboard.command import ZENFI, not_ours, refusal, zenfi

FORBID_PTRACE = Path(__file__).parent.parent / "fixtures" / "forbid_ptrace.py"


def test_fly_prints_one_outcome() -> None:
    command = [ZENFI, "fly", "--world", "sparse", "--seed", "7", "--link", "5,0.01", "--json"]
    answer = subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    assert answer.returncode == 0
    assert answer.stderr == ""
    outcome = json.loads(answer.stdout)
    assert outcome["result"] == "success"
    assert {"success", "flight_time_s", "distance_m", "energy_kj", "replans"} <= set(outcome["qof"])
    assert {"digest", "wall_s", "nodes"} <= set(outcome)
    assert outcome["spec"]["link"] == {"delay_ms": 5.0, "loss": 0.01}
    assert outcome["nodes"]["sim"]["lost"] > 0


def test_the_list_of_commands_loads_none_of_them() -> None:
    told = "import sys; from dashboard.cli import main; main(['--help']); "
    heavy = "print({'numpy', 'sqlalchemy', 'zenoh', 'rich'} & set(sys.modules))"
    answer = subprocess.run(
        [sys.executable, "-c", told + heavy], capture_output=True, text=True, check=True, timeout=PATIENCE_S
    )
    *lines, loaded = answer.stdout.splitlines()
    assert loaded == "set()"
    assert all(any(line.split()[:1] == [name] for line in lines) for name in COMMANDS)
    assert max(map(len, lines)) < 80


@pytest.mark.parametrize("name", COMMANDS)
def test_each_command_of_the_list_is_there(name: str) -> None:
    command = zenfi_group.get_command(Context(zenfi_group), name)
    assert command is not None
    assert command.name == name


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("fly", "--world", "nowhere"), "nowhere"),
        (("fly", "--planner", "crystal_ball"), "crystal_ball"),
        (("fly", "--mission", "dancing"), "dancing"),
        (("fly", "--fault", "instruction:frontier"), "never runs in mission 'navigation'"),
        (("fly", "--platform", "abacus"), "abacus"),
        (("fly", "--link", "slow"), "MS[,LOSS], e.g. 20 or 20,0.01"),
        (("fly", "--link", "20,0.01,5"), "MS[,LOSS]"),
        (("fly", "--link", "nan"), "link.delay_ms"),
        (("fly", "--link", "20,1"), "link.loss"),
        (("fly", "--link", "20", "--clock", "realtime"), "leave out --clock realtime"),
        (("fly", "--detector", "crystal_ball"), "unknown detector 'crystal_ball'; installed: autoencoder"),
        (("fly", "--detector", "gaussian,gate"), "NAME=VALUE"),
        (("fly", "--detector", "gaussian,gate=ajar"), "detector.gate"),
        (("fly", "--detector", "gaussian,recovery=wings"), "detector.recovery"),
        (("fly", "--detector", "gaussian,model=missing.json"), "missing.json"),
        (("fly", "--fault", "instruction:teapot"), "teapot"),
        (("fly", "--fault", "rrt_star"), "LEVEL:TARGET"),
        (("fly", "--fault", "quantum:rrt_star"), "level"),
        (("fly", "--fault", "instruction:rrt"), "--planner rrt"),
        (("fly", "--fault", "instruction:pid,bits"), "NAME=VALUE"),
        (("fly", "--fault", "instruction:pid,bits=1,bits=2"), "twice"),
        (("fly", "--fault", "instruction:pid,seed=4"), "--fault-seed"),
        (("fly", "--fault", "instruction:pid,wings=2"), "wings"),
        (("fly", "--fault", "instruction:pid,field=exponent,register_class=gpr"), "floating-point"),
        (("fly", "--fault", "instruction:pid,model=stuck_at"), "stuck_value"),
        (("fly", "--fault", "instruction:pid,register_class=flags,bit_numbers=0+3"), "bit 3"),
        (("fly", "--fault", "instruction:pid,mask=byte,bits=2"), "mask byte itself says how many"),
        (("fly", "--fault", "instruction:pid,mask=histogram"), "FILE.toml"),
        (("fly", "--fault", "instruction:pid,mask=histogram,histogram=no.toml"), "no.toml: No such file"),
        (("kernels", "run", "--fault", "mask=histogram,histogram=no.toml"), "no.toml: No such file"),
        (("inject", "--pid", "1", "--fault", "mask=histogram,histogram=no.toml"), "no.toml: No such file"),
        (("fly", "--seed", "-1"), "seed"),
        (("fly", "--seed", "many"), "many"),
        (("fly", "--fault", "instruction:pid", "--fault-seed", "-3"), "seed"),
        (("fly", "--colour", "red"), "--colour"),
        (("campaign", "run", "missing.toml"), "missing.toml"),
        (("conquer",), "conquer"),
    ],
)
def test_bad_input_is_one_clear_line_and_status_2(arguments: tuple[str, ...], says: str) -> None:
    assert says in refusal(*arguments)


def test_a_machine_that_forbids_tracing_is_told_before_anything_starts() -> None:
    command = [sys.executable, str(FORBID_PTRACE), ZENFI, "fly", "--fault", "instruction:pid"]
    answer = subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    assert answer.returncode == 2
    assert answer.stdout == ""
    assert len(answer.stderr.splitlines()) == 1
    assert "ptrace" in answer.stderr
    assert "--cap-add SYS_PTRACE" in answer.stderr


@pytest.mark.parametrize(
    ("target", "text", "says"),
    [
        ("instruction:pid", "[bits]\n1 = 0.6\n", "upsets.toml: specification: bits sums to 0.6"),
        ("instruction:pid", "[bits]\n1 = -0.6\n", "upsets.toml: bits.1: "),
        ("instruction:pid", "[bits\n", "upsets.toml: not valid TOML"),
        ("instruction:pid", "[wings]\n1 = 1.0\n", "upsets.toml: wings"),
        (
            "instruction:pid,register_class=flags",
            "[positions]\n3 = 1.0\n",
            "histogram: bit 3 is no status flag",
        ),
        ("source:cloud.x", "[positions]\n3 = 0.5\n40 = 0.5\n", "cloud.x is a 32-bit floating-point number"),
        ("source:cloud.x", "[bits]\n1 = 0.5\n33 = 0.5\n", "cloud.x is a 32-bit floating-point number"),
    ],
)
def test_a_histogram_that_cannot_be_drawn_from_is_refused(
    target: str, text: str, says: str, tmp_path: Path
) -> None:
    file = tmp_path / "upsets.toml"
    file.write_text(text)
    assert says in refusal("fly", "--fault", f"{target},mask=histogram,histogram={file}")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('name = "x\n', "TOML"),
        ('name = "x"\nruns = 0\narms = [{name = "a"}]', "runs"),
        ('name = "x"\nruns = 1\narms = []', "arms"),
        ('name = "x"\nruns = 1\nwings = 2\narms = [{name = "a"}]', "wings"),
        ('name = "x"\nruns = 1\n[[arms]]\nname = "a"\nfault = {target = "pid", field = "nose"}', "field"),
        ('name = "x"\nruns = 1\n[[arms]]\nname = "a"\nfault = {target = "pid", model = "stuck_at"}', "stuck"),
        ('name = "../x"\nruns = 1\narms = [{name = "a"}]', "name"),
        ('name = "x"\nruns = 1\narms = [{name = "a"}, {name = "a"}]', "arms"),
        ('name = "x"\nruns = 1\narms = [{name = "a", fault = {target = "teapot"}}]', "teapot"),
        ('name = "x"\nruns = 1000000000\narms = [{name = "a"}]', "runs"),
        ('name = "x"\nruns = 1\nartefacts = "../up"\narms = [{name = "a"}]', "artefacts"),
        ('name = "x"\nruns = 1\nmission = {world = "nowhere"}\narms = [{name = "a"}]', "nowhere"),
        ('name = "x"\nruns = 1\nmission = {mission = "dancing"}\narms = [{name = "a"}]', "dancing"),
    ],
)
def test_a_bad_campaign_is_refused_with_the_field_named(text: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "campaign.toml"
    path.write_text(text)
    assert says in refusal("campaign", "run", path)
    assert not (tmp_path / "home").exists()


def test_packages_of_the_folder_where_a_campaign_is_run_are_not_taken_for_ours(tmp_path: Path) -> None:
    (not_ours(tmp_path) / "x.toml").write_text(
        'name = "x"\nruns = 1\narms = [{name = "golden"}]\nmission = {limits = {mission_time_s = 1.0}}\n'
    )
    command = [ZENFI, "campaign", "run", "x.toml", "--json", "--store", str(tmp_path / "store")]
    answer = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=PATIENCE_S
    )
    assert answer.returncode == 0, answer.stderr
    assert json.loads(answer.stdout.splitlines()[-1])["summary"][0]["runs"] == 1


def test_a_campaign_flies_its_arms_and_sums_them_up(tmp_path: Path) -> None:
    path = tmp_path / "campaign.toml"
    path.write_text(
        'name = "x"\nruns = 2\narms = [{name = "golden"}, {name = "flip", fault = {target = "pid"}}]\n'
        "mission = {seed = 3, limits = {mission_time_s = 4.0}}\n"
    )
    answer = zenfi("campaign", "run", str(path), "--json")
    lines = [json.loads(line) for line in answer.stdout.splitlines()]
    assert answer.returncode == 0
    first, *flights, last = lines
    assert first["campaign"] == last["campaign"] == "x-1"
    assert first["forecast"]["runs"] == 4
    assert sorted((line["arm"], line["index"]) for line in flights) == [
        ("flip", 0),
        ("flip", 1),
        ("golden", 0),
        ("golden", 1),
    ]
    golden = {line["index"]: line["outcome"]["digest"] for line in flights if line["arm"] == "golden"}
    for line in flights:
        if line["arm"] == "flip":
            assert line["outcome"]["golden"]["digest"] == golden[line["index"]]
    assert [arm["runs"] for arm in last["summary"]] == [2, 2]
    assert last["phase"] == "done"
    compared = zenfi("campaign", "compare", "x-1", "--json")
    assert json.loads(compared.stdout)["pairs"] == 2
    page = tmp_path / "results.md"
    assert zenfi("campaign", "compare", "x-1", "--against", "golden", "--page", str(page)).returncode == 0
    told = page.read_text()
    assert f"zenfi campaign compare x-1 --against golden --page {page}" in told
    assert "beside golden" in told
    assert sum(line.startswith("| ") for line in told.splitlines()) == 3  # a head and two arms
    assert "x-1" in zenfi("campaign", "list").stdout
    shown = [json.loads(line) for line in zenfi("campaign", "show", "x-1", "--json").stdout.splitlines()]
    assert shown[0]["done"] == 4
    assert shown[1]["summary"] == last["summary"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("show", "demo-7"), "demo-7"),
        (("resume",), "nothing to resume"),
        (("cancel", "x"), "x"),
        (("compare", "1", "2", "--against", "golden"), "--against"),
        (("export", "1", "table.xlsx"), "1"),
        (("list", "--store", "/proc/nowhere"), "--store"),
    ],
)
def test_a_campaign_that_is_not_there_is_one_clear_line(arguments: tuple[str, ...], says: str) -> None:
    assert says in refusal("campaign", *arguments)


@pytest.mark.soak
@pytest.mark.parametrize(
    ("stop", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 130), (signal.SIGKILL, -9)]
)
def test_a_stopped_campaign_leaves_nothing_behind(stop: int, status: int) -> None:
    with subprocess.Popen(
        [ZENFI, "campaign", "run", "demo", "--json"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as command:
        wait_until(lambda: node(command.pid, "control") is not None, PATIENCE_S)
        family = descendants(command.pid)
        assert not segments(family)  # which who is killed would leave
        os.kill(command.pid, stop)
        assert command.wait(60.0) == status
    wait_until(lambda: not any(map(alive, family)))
    if stop != signal.SIGKILL:
        assert not any(folders(pid) for pid in family)
    assert zenfi("doctor").returncode == 0  # of who is killed, the next start removes it
    assert not any(folders(pid) for pid in family)


def test_doctor_tells_what_the_machine_allows() -> None:
    answer = zenfi("doctor", "--json")
    checks = [json.loads(line) for line in answer.stdout.splitlines()]
    assert len(checks) >= 5
    assert (answer.returncode == 0) == all(check["ok"] for check in checks)


def test_doctor_finds_that_nothing_can_fly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where only the processes of a flight lack what they import."""
    (tmp_path / "ompl").mkdir()
    (tmp_path / "ompl" / "__init__.py").write_text("raise ImportError('ompl is broken')\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    answer = zenfi("doctor", "--json")
    amiss = [one for one in map(json.loads, answer.stdout.splitlines()) if not one["ok"]]
    assert answer.returncode == 1
    assert [one["check"] for one in amiss] == ["a flight in Sparse: the fork server did not start"]
    assert "install" in amiss[0]["remedy"]
