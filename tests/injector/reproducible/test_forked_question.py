"""Questions that a fork answers, so that what it reads leaves nothing in the memory of who asks."""

import os
import signal
import subprocess
from pathlib import Path

import pytest

from injector.reproducible import launch
from injector.reproducible.forked_question import answered_by_a_fork
from tests.process_memory import memory

BEGINNING = """
import os
from injector.reproducible.bootstrap import give_back_standard_streams
from injector.reproducible.pid_namespace import begin
give_back_standard_streams()
begin()
print("ready", flush=True)
os.read(0, 1)
"""
WAITED = b"ctxt_switches:"
"""What the kernel writes before the number in ``/proc/self/status``."""


def killed() -> bool:
    signal.raise_signal(signal.SIGKILL)
    return True


def test_the_answer_is_that_of_the_fork() -> None:
    asking = os.getpid()
    assert answered_by_a_fork(lambda: os.getppid() == asking)
    assert not answered_by_a_fork(lambda: os.getpid() == asking)
    assert not answered_by_a_fork(lambda: bool(1 // 0))
    assert not answered_by_a_fork(killed)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root begins without a fork that goes on in its place")
def test_how_often_a_process_has_waited_is_not_in_its_memory(tmp_path: Path) -> None:
    """The kernel tells it in digits, and a longer text would be taken from elsewhere in the heap."""
    for ours in ("injector", "services"):
        (tmp_path / ours).symlink_to(Path(__file__).parents[3] / ours)
    (tmp_path / "beginning.py").write_text(BEGINNING)
    given = launch.environment({**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}, "test")
    with subprocess.Popen(
        launch.command("beginning"),
        env=given | {"PYTHONPATH": str(tmp_path)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline()
        found = memory(process.pid)
        process.communicate()
    assert not any(WAITED in words.tobytes() for words in found.values())
