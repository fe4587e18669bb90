"""Processes that have the same pids each time, made as a fork server makes them, by root and by a user."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

ROOT = Path(__file__).parents[3]
NOBODY = 65534
LOADER_FAILED = 127
"""Exit status of ld.so(8) if it cannot read a library, as that of a Python copied from a closed folder."""

TELLING = """
import os, sys
from threading import get_native_id
from injector.reproducible.fork_loop import fork_on_order, warm_up
from injector.reproducible.pid_namespace import NOWHERE, begin
from services.system.process_stat import listed_pid

warm_up()
home = begin()
if home == NOWHERE:
    sys.exit(os.EX_NOPERM)
reads, orders = os.pipe()
waits_for_end, end = os.pipe()
if not os.fork():
    for _ in range(3):
        os.write(orders, b"+")
        os.read(waits_for_end, 1)
    os._exit(0)
os.close(orders)
if not fork_on_order(reads, home):
    sys.exit()
waits, go = os.pipe()
node = os.fork()
if not node:
    os.read(waits, 1)
    print(os.getpid(), get_native_id(), os.getppid(), os.readlink("/proc/self"), flush=True, end=" ")
    os.abort()
print(os.getpid(), node, listed_pid(node), flush=True, end=" ")
os.write(go, b"+")
print(os.waitstatus_to_exitcode(os.waitpid(node, 0)[1]), flush=True)
os.write(end, b"+")
os._exit(0)
"""


def tell(user: int | None, cache: Path) -> subprocess.CompletedProcess[str]:
    """What ``TELLING`` tells.

    :raises PermissionError: if the user may not run this Python.
    """
    told = subprocess.run(
        [sys.executable, "-B", "-c", TELLING],
        env={"PYTHONPATH": f"{ROOT}:{os.pathsep.join(sys.path)}", "NUMBA_CACHE_DIR": str(cache)},
        cwd="/",
        capture_output=True,
        text=True,
        check=False,
        user=user,
        group=user,
        extra_groups=None if user is None else [],
    )
    if told.returncode == LOADER_FAILED:
        raise PermissionError(told.stderr)
    return told


@pytest.mark.parametrize("user", [None, NOBODY])
def test_each_time_the_pids_are_the_same(user: int | None) -> None:
    if user is not None and os.getuid():
        pytest.skip("only root can be another user")
    try:
        with TemporaryDirectory() as folder:
            cache = Path(folder)
            cache.chmod(0o777)  # whoever the other user is
            told = tell(user, cache)
    except PermissionError:
        pytest.skip("another user may not run this Python: its folder is closed")
    if told.returncode == os.EX_NOPERM:
        pytest.skip("no pid namespaces here")
    assert not told.stderr
    rounds = [list(map(int, line.split())) for line in told.stdout.splitlines()]
    # Reaper and node as the reaper sees them; pid, tid and parent as the node does; its end is what it was.
    assert [[*one[:2], *one[3:6], one[7]] for one in rounds] == [[1, 2, 2, 2, 1, -signal.SIGABRT]] * 3
    outside = [(one[2], one[6]) for one in rounds]
    assert len(set(outside)) == 3
    assert all(said_by_reaper == said_by_proc for said_by_reaper, said_by_proc in outside)
