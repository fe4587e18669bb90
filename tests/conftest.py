"""What several folders' tests need: a fork server, and a look at what is left behind."""

import os
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from deploy.forkserver import ForkServer
from deploy.scratch import PREFIX

# No test asserts wall time, also not hypothesis' own deadline.
settings.register_profile("zenfi", deadline=None)
settings.load_profile("zenfi")


@pytest.fixture(scope="session")
def server() -> Iterator[ForkServer]:
    """One fork server for all flights of the test run."""
    fork_server = ForkServer()
    yield fork_server
    fork_server.close()


def wait_until(condition: Callable[[], bool], timeout_s: float = 20.0) -> None:
    """Wait for something that happens in another process; fail if it does not."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.002)


def processes(marker: str) -> list[int]:
    """Pids of living processes whose name or command line holds ``marker``."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            try:
                name = (entry / "comm").read_text()
                command = (entry / "cmdline").read_bytes().decode(errors="replace")
                state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
            except (FileNotFoundError, ProcessLookupError):
                continue
            if state != "Z" and (marker in name or marker in command):
                found.append(int(entry.name))
    return found


def folders() -> list[Path]:
    """Folders of missions, living or dead."""
    return list(Path(tempfile.gettempdir()).glob(f"{PREFIX}*-*-*"))


def segments() -> list[str]:
    """Shared memory segments of Zenoh."""
    return [entry.name for entry in Path("/dev/shm").glob("*.zenoh*")]  # noqa: S108 - to see that it is empty
