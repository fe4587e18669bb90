"""What several folders' tests need: a fork server, and a look at what is left behind."""

import contextlib
import os
import re
import signal
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from deploy.config.workdir import PREFIX
from deploy.mission.fork_protocol import SIDE_SERVER
from deploy.mission.fork_server import ForkServer
from injector.reproducible.pid_namespace import CALLER
from tests import tiers

PATIENCE_S = 300.0
"""For what comes in the end, on however busy a machine; not for what would end by itself in that time."""

# No test asserts wall time, also not hypothesis' own deadline.
settings.register_profile("zenfi", deadline=None)
settings.load_profile("zenfi")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give each test its tier; before ``-m`` chooses by it."""
    tiers.sort_into_tiers(items)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Have a unit test fail that starts a process."""
    tiers.guard(item)
    try:
        return (yield)
    finally:
        tiers.guard(None)


@pytest.fixture(scope="session", autouse=True)
def _what_is_started_heeds_signals() -> Iterator[None]:
    """Have processes of tests begin with the default disposition of the signals by which people end them.

    A run in the background of a script has SIGINT ignored, one under nohup SIGHUP, and what is ignored is
    inherited. A handler is not: exec resets it. So this run itself goes on ignoring what it ignored.
    """
    asking = (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP, signal.SIGTERM)
    ignored = [number for number in asking if signal.getsignal(number) is signal.SIG_IGN]
    for number in ignored:
        signal.signal(number, lambda *_: None)
    yield
    for number in ignored:
        signal.signal(number, signal.SIG_IGN)


@pytest.fixture(scope="session")
def server() -> Iterator[ForkServer]:
    """One fork server for all flights of the test run."""
    fork_server = ForkServer()
    yield fork_server
    fork_server.close()


def wait_until(condition: Callable[[], bool], timeout_s: float = 60.0) -> None:
    """Wait for something that happens in another process; fail if it does not."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.002)


def descendants(pid: int) -> dict[int, str]:
    """The living children of a process, their children and so on: name by pid."""
    family: dict[int, list[tuple[int, str]]] = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            stat = (entry / "stat").read_text()
        except (FileNotFoundError, ProcessLookupError):
            continue
        name, _, rest = stat.partition("(")[2].rpartition(")")
        state, parent = rest.split()[:2]
        if state != "Z":
            family.setdefault(int(parent), []).append((int(entry.name), name))
    found: dict[int, str] = {}
    waiting = [pid]
    while waiting:
        for child, name in family.get(waiting.pop(), []):
            found[child] = name
            waiting.append(child)
    return found


def forked(server: int) -> dict[int, str]:
    """What a fork server has forked for flights, by pid: all but the processes that fork on its behalf."""
    return {pid: name for pid, name in descendants(server).items() if name not in (SIDE_SERVER, CALLER)}


def node(supervisor: int, name: str) -> int | None:
    """The pid of a node of the mission that a process supervises."""
    comm = f"zenfi-{name}"[:15]
    return next((pid for pid, found in descendants(supervisor).items() if found == comm), None)


def cpu_s(pid: int) -> float:
    """Processor time that a process has used, 0 if it is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def alive(pid: int) -> bool:
    """Whether a process exists and is no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def folders(owner: int) -> list[Path]:
    """Folders of missions that a process supervised, living or dead."""
    return list(Path(tempfile.gettempdir()).glob(f"{PREFIX}{owner}-*"))


def segments(pids: Iterable[int]) -> set[str]:
    """Zenoh's shared memory segments that processes have mapped, from a session's opening on."""
    found = set()
    for pid in pids:
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            found.update(re.findall(r"\S+\.zenoh\b", Path(f"/proc/{pid}/maps").read_text()))
    return found
