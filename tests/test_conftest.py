"""The test run does not depend on how it was started, nor on what else runs on the machine."""

import os
import subprocess
import sys
from pathlib import Path

from tests.conftest import segments

ROOT = Path(__file__).parents[1]
TEST = """
import os, signal, subprocess

def test() -> None:
    for number in (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP, signal.SIGTERM):
        os.kill(os.getpid(), number)
        with subprocess.Popen(["sleep", "10"]) as started:
            started.send_signal(number)
        assert started.returncode == -number
"""


def test_a_run_that_ignores_signals_starts_processes_that_heed_them(tmp_path: Path) -> None:
    """As in the background of a script, and under nohup: what is ignored is inherited."""
    file = tmp_path / "test_started.py"
    file.write_text(TEST)
    run = [sys.executable, "-m", "pytest", "-p", "tests.conftest", f"--rootdir={tmp_path}", str(file)]
    ignoring = ["sh", "-c", 'trap "" INT QUIT HUP TERM; exec "$@"', "sh", *run]
    ended = subprocess.run(ignoring, cwd=ROOT, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout


OTHER_PROGRAM = """
import zenoh

config = zenoh.Config()
config.insert_json5("transport/shared_memory/enabled", "true")
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config):
    print("open", flush=True)
    input()
"""


def test_shared_memory_of_other_programs_is_theirs() -> None:
    before = segments([os.getpid()])
    with subprocess.Popen(
        [sys.executable, "-c", OTHER_PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "open\n"
        assert segments([os.getpid()]) == before
        assert len(segments([other.pid])) == 1
        other.communicate("\n")
