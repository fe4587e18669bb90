"""The supervisor's end of the fork server: what becomes of it when somebody meddles with the server."""

import os
import signal
from collections.abc import Iterator
from contextlib import closing

import pytest

from deploy.mission import fork_server
from deploy.mission.flight import fly
from deploy.mission.fork_protocol import SIDE_SERVER
from deploy.mission.fork_server import ForkServer, ForkServerError
from injector.reproducible.pid_namespace import CALLER
from services.models.faults.specification import FaultSpec
from services.models.mission import Limits, MissionSpec
from tests.conftest import PATIENCE_S, alive, descendants, wait_until

SHORT = MissionSpec(seed=7, limits=Limits(mission_time_s=1.0))


@pytest.fixture
def own_server() -> Iterator[ForkServer]:
    with closing(ForkServer()) as server:
        yield server


@pytest.mark.parametrize(("which", "fault"), [(CALLER, None), (SIDE_SERVER, FaultSpec(target="pid"))])
def test_a_server_that_is_stopped_for_ever_is_ended(
    own_server: ForkServer, which: str, fault: FaultSpec | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fork_server, "STOPPED_S", 0.5)
    family = descendants(own_server.pid)
    # Where nodes have no fixed pids there is no caller: the server itself forks them.
    os.kill(next((pid for pid, name in family.items() if name == which), own_server.pid), signal.SIGSTOP)
    with pytest.raises(ForkServerError, match="gone"):
        fly(SHORT.model_copy(update={"fault": fault}), own_server)
    assert own_server.is_lost()
    wait_until(lambda: not any(map(alive, [own_server.pid, *family])), PATIENCE_S)


def test_a_server_that_is_stopped_is_closed_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fork_server, "STOPPED_S", 0.5)
    with closing(ForkServer()) as server:
        family = descendants(server.pid)
        os.kill(server.pid, signal.SIGSTOP)
    wait_until(lambda: not any(map(alive, [server.pid, *family])), PATIENCE_S)
