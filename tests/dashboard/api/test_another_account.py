"""Another user of the machine gets at nothing of a service that flies: no file, no socket, no process."""

import ctypes
import os
import socket
import stat
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import httpx

from dashboard.client import Client
from services.models.mission import Limits, MissionSpec
from tests.conftest import descendants
from tests.dashboard.api.conftest import Serving
from tests.fixtures.another_user import NOBODY, as_nobody, needs_root, user

PLACES = (Path("/tmp"), Path("/dev/shm"))  # noqa: S108 - where everybody may look
PTRACE_SEIZE = 0x4206
LONG = MissionSpec(mission="scanning", limits=Limits(mission_time_s=60))


def opened(path: Path, kind: int) -> Iterator[str]:
    """How a file, folder or socket can be opened."""
    ways: dict[str, Callable[[], Any]] = {}
    if stat.S_ISREG(kind):
        ways = {"read": lambda: path.open("rb").close(), "written": lambda: path.open("r+b").close()}
    elif stat.S_ISDIR(kind):
        ways = {"listed": lambda: list(path.iterdir())}
    elif stat.S_ISSOCK(kind):
        ways = {"connected to": lambda: socket.socket(socket.AF_UNIX).connect(str(path))}
    yield from (f"{path} is {way}" for way, attempt in ways.items() if works(attempt))


def works(attempt: Callable[[], Any]) -> bool:
    """Whether the system lets us."""
    try:
        attempt()
    except OSError:
        return False
    return True


def of_processes(pids: list[int]) -> list[str]:
    """What of processes can be read, and which can be signalled or traced."""
    libc = ctypes.CDLL(None, use_errno=True)
    found = []
    for pid in pids:
        attempts: dict[str, Callable[[], Any]] = {
            **{
                f"its {name}": partial(Path(f"/proc/{pid}/{name}").read_bytes) for name in ("environ", "maps")
            },
            **{f"its {name}": partial(Path(f"/proc/{pid}/{name}").readlink) for name in ("cwd", "exe")},
            "its descriptors": partial(os.listdir, f"/proc/{pid}/fd"),
            "its memory": partial(os.open, f"/proc/{pid}/mem", os.O_RDONLY),
            "a signal": partial(os.kill, pid, 0),
        }
        found += [f"{what} of {pid}" for what, attempt in attempts.items() if works(attempt)]
        if libc.ptrace(PTRACE_SEIZE, pid, None, None) == 0:
            found.append(f"a trace of {pid}")
    return found


def ours(folder: Path, pids: list[int]) -> dict[Path, int]:
    """The store's files, and what the processes have where everybody may look, with their modes."""
    names = {str(pid) for pid in pids}
    shared = [one for place in PLACES for one in place.iterdir() if one.lstat().st_uid == os.getuid()]
    theirs = [one for one in shared if names & set(one.name.replace(".", "-").split("-"))]
    deep = [one for top in (folder, *theirs) for one in (top, *top.rglob("*"))]
    return {one: one.lstat().st_mode for one in deep if one.exists()}


@needs_root
def test_a_flight_under_way_is_reached_by_nobody_else(service: Serving, client: Client) -> None:
    label = client.flights.create(LONG).campaign.campaign
    try:
        next(event for event in client.watch(label) if event.kind == "flight")
        pids = [service.process.pid, *descendants(service.process.pid)]
        paths = ours(service.said.parent, pids)
        assert any(map(stat.S_ISSOCK, paths.values())), "the flight's own sockets are looked at"
        assert as_nobody(lambda: [way for one, kind in paths.items() for way in opened(one, kind)]) == []
        assert as_nobody(lambda: of_processes(pids)) == []
    finally:
        client.campaigns.command(label, "cancel")


REQUEST = b'{"preset": "demo"}'
CREATE = (
    b"POST /api/v1/campaigns HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    b"Content-Length: %d\r\n\r\n%b" % (len(REQUEST), REQUEST)
)


@needs_root
def test_another_account_on_the_machine_reads_and_starts_nothing(service: Serving) -> None:
    host, port = service.address.removeprefix("http://").split(":")
    with user(NOBODY):
        asking = socket.create_connection((host, int(port)))
    with asking:
        asking.sendall(CREATE)
        assert asking.recv(1000).startswith(b"HTTP/1.1 401 ")
    for _ in range(50):  # gone before it is asked whose the request is
        with user(NOBODY):
            leaving = socket.create_connection((host, int(port)))
        leaving.sendall(CREATE)
        leaving.close()
    names = [one["campaign"] for one in httpx.get(f"{service.address}/api/v1/campaigns").json()["campaigns"]]
    assert not [name for name in names if name.startswith("demo")]
