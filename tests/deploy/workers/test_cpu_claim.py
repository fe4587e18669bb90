"""Every worker gets a processor that no other has."""

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest

from deploy.workers.cpu_claim import claim

SCRIPT = """
import os
from deploy.workers.cpu_claim import claim
claimed = claim()
print(claimed and claimed[0], flush=True)
os.kill(os.getpid(), 9)
"""


@pytest.fixture
def processor() -> Iterator[int]:
    """The last one, as if this machine had no other."""
    before = os.sched_getaffinity(0)
    last = max(before)
    os.sched_setaffinity(0, {last})
    yield last
    os.sched_setaffinity(0, before)


def elsewhere() -> str:
    """What another process is given, which is killed afterwards."""
    return subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, check=False, text=True).stdout


def test_a_processor_is_claimed_once_and_freed_with_its_owner(processor: int) -> None:
    mine = claim()
    if mine is None:
        pytest.skip("a worker of another campaign runs on it")
    assert mine[0] == processor
    assert elsewhere() == "None\n"
    mine[1].close()
    for _ in range(2):
        assert elsewhere() == f"{processor}\n"
