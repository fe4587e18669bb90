"""Questions that a fork answers, so that what it reads leaves nothing in the memory of who asks."""

import os
import signal
import subprocess
from pathlib import Path

import pytest

from injector.reproducible import launch
from injector.reproducible.forked_question import answered_by_a_fork
from services.system.process_stat import process_stat
from tests.conftest import wait_until
from tests.process_memory import Memory, different, memory

BEGINNING = """
import os, time
from injector.reproducible.bootstrap import give_back_standard_streams
from itertools import repeat
from injector.reproducible.pid_namespace import begin
give_back_standard_streams()
for _ in repeat(None, int(os.read(0, 5))):
    time.sleep(0)
begin()
print("ready", flush=True)
os.read(0, 1)
"""
SELDOM, OFTEN = b"00300", b"30000"


def killed() -> bool:
    signal.raise_signal(signal.SIGKILL)
    return True


def test_the_answer_is_that_of_the_fork() -> None:
    asking = os.getpid()
    assert answered_by_a_fork(lambda: os.getppid() == asking)
    assert not answered_by_a_fork(lambda: os.getpid() == asking)
    assert not answered_by_a_fork(lambda: bool(1 // 0))
    assert not answered_by_a_fork(killed)


def memory_after_waiting(times: bytes, folder: Path) -> Memory:
    command = launch.command("waiting")
    given = {**os.environ, "NUMBA_CACHE_DIR": str(folder)}
    surroundings = launch.environment(given, "test") | {"PYTHONPATH": str(folder)}
    with subprocess.Popen(
        command, env=surroundings, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(times)
        process.stdin.flush()
        process.stdout.readline()
        wait_until(lambda: process_stat(process.pid).state == "S")  # or it has not begun to read
        found = memory(process.pid, stack=False)
        process.communicate()
    return found


@pytest.mark.skipif(os.geteuid() != 0, reason="only root begins without a fork that goes on in its place")
def test_how_often_a_process_has_waited_leaves_no_trace(tmp_path: Path) -> None:
    """The kernel tells it in digits, and a longer text would be taken from elsewhere in the heap."""
    for ours in ("injector", "services"):
        (tmp_path / ours).symlink_to(Path(__file__).parents[3] / ours)
    (tmp_path / "waiting.py").write_text(BEGINNING)
    memory_after_waiting(SELDOM, tmp_path)  # compiles
    seldom, again, often = (memory_after_waiting(times, tmp_path) for times in (SELDOM, SELDOM, OFTEN))
    alike = different(seldom, again, numbers=False)
    assert len(different(seldom, often, numbers=False) - alike) <= 4  # the number itself
