"""What a stack file may say, and what is refused in one line."""

import subprocess
import sys
from pathlib import Path

import pytest

from deploy.compose.reading import read_stack
from deploy.compose.stack_file import BackOff
from deploy.config.certificates import Machine, write_certificates
from deploy.config.link_security import KEY
from deploy.errors import BadSpecError

GOOD = """
name = "mine"
[processes.a]
command = ["sleep", "1"]
"""


def read(tmp_path: Path, text: str) -> str:
    """The one line with which a stack file is refused."""
    file = tmp_path / "stack.toml"
    file.write_text(text)
    with pytest.raises(BadSpecError) as refused:
        read_stack(file)
    told = str(refused.value)
    assert told.startswith(f"{file}: ")
    assert "\n" not in told
    return told


@pytest.mark.parametrize(
    ("more", "told"),
    [
        ('needs = ["b"]', "a needs b, which is not declared"),
        ('needs = ["a"]', "circle: a needs a"),
        (
            'needs = ["b"]\n[processes.b]\ncommand = ["x"]\nneeds = ["a"]',
            "processes need each other in a circle",
        ),
        ('restart = "sometimes"', "processes.a.restart"),
        ('ready = { exits = true }\nrestart = "always"', 'cannot have restart = "always"'),
        ('ready = { exits = true, announces = "a" }', "no other sign of readiness"),
        ('ready = { http = "ftp://x/" }', "http://127.0.0.1:8000/ready"),
        ('stop = { signal = "SIGSTOP" }', "processes.a.stop.signal"),
        ("stop = { grace_s = -1 }", "processes.a.stop.grace_s"),
        ("backoff = { factor = 0.5 }", "processes.a.backoff.factor"),
        ("grace = 3", "processes.a.grace"),
        ('environment = { "A=B" = "x" }', "processes.a.environment"),
        ('restarts_with = ["b"]', "restarts_with names b, which is not among its needs"),
        ("alive = { every_s = 1 }", "processes.a.alive: name a sign: http, announces or publishes"),
        ('alive = { http = "x" }', "http://127.0.0.1:8000/ready"),
        ('alive = { announces = "a", failures = 0 }', "processes.a.alive.failures"),
        ('ready = { exits = true }\nalive = { announces = "a" }', "cannot be probed: remove alive"),
        ("limits = { memory_bytes = 1 }", "processes.a.limits.memory_bytes"),
        ("limits = { cpus = 1 }", "processes.a.limits.cpus"),
        ('folder = "not-there"', "processes.a.folder"),
        ('[processes."../b"]\ncommand = ["x"]', "processes"),
        ('[processes.supervisor]\ncommand = ["x"]', "choose another"),
        ('[bus]\nlisten = ["tcp/0.0.0.0:7447"]', "use tls/, or set insecure = true"),
        ('[bus]\nconnect = ["udp/127.0.0.1:7447"]', "tls/HOST:PORT"),
        ('[bus]\nlisten = ["tls/0.0.0.0:7447"]', "tls = FOLDER, made by zenfi certificates"),
        ('[bus]\nconnect = ["tls/lab-2:7447"]', "tls = FOLDER, made by zenfi certificates"),
        ('[bus]\ntls = "nowhere"', "has no ca.pem: zenfi certificates makes such folders"),
    ],
)
def test_nonsense_is_refused_by_name(tmp_path: Path, more: str, told: str) -> None:
    assert told in read(tmp_path, GOOD + more)


def test_a_command_is_a_list_and_no_shell_line(tmp_path: Path) -> None:
    assert "processes.a.command" in read(tmp_path, 'name = "x"\n[processes.a]\ncommand = "sleep 1"')


def test_folders_begin_at_the_file(tmp_path: Path) -> None:
    (tmp_path / "work").mkdir()
    file = tmp_path / "stack.toml"
    file.write_text('logs = "log"' + GOOD + 'folder = "work"\n[bus]\nlisten = ["tcp/127.0.0.1:7447"]')
    stack = read_stack(file)
    assert stack.processes["a"].folder == str(tmp_path / "work")
    assert stack.logs == str(tmp_path / "log")


def test_what_comes_along_is_a_good_stack() -> None:
    stack = read_stack(None)
    assert stack.name == "laboratory"
    assert stack.processes["api"].command == ("zenfi", "serve")


def test_pauses_are_bounded_however_many_restarts() -> None:
    assert BackOff(first_s=1, factor=2, most_s=60).pause_s(1_000_000) == 60


def test_the_supervisor_imports_neither_simulator_nor_compiler() -> None:
    heavy = "{'numba', 'mujoco', 'ompl', 'scipy'} & set(sys.modules)"
    script = f"import sys, deploy.compose.daemon; print(*sorted({heavy}))"
    answer = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == ""


def test_the_folder_of_certificates_is_the_files_or_the_one_that_is_named(tmp_path: Path) -> None:
    of_file, named = write_certificates(tmp_path, [Machine("lab-1"), Machine("lab-2")], 30)
    file = tmp_path / "stack.toml"
    file.write_text(GOOD + '[bus]\nlisten = ["tls/0.0.0.0:7447"]\ntls = "lab-1"')
    assert read_stack(file).bus.tls == str(of_file)
    assert read_stack(file, tls=named).bus.tls == str(named)


def test_a_key_that_others_can_read_is_refused(tmp_path: Path) -> None:
    (folder,) = write_certificates(tmp_path, [Machine("lab-1")], 30)
    (folder / KEY).chmod(0o640)
    assert "can be read by others: chmod 600" in read(tmp_path, GOOD + '[bus]\ntls = "lab-1"')
