"""The state of stacks on Zenoh, on this machine and between supervisors."""

import contextlib
import shutil
import socket
from pathlib import Path

import zenoh

from deploy.compose.bus import STATE, all_stacks, changes_key
from deploy.compose.control import ProcessView, StackView
from deploy.config.certificates import Machine, write_certificates
from deploy.config.link_security import AUTHORITY
from services.bus.session import BusAddress, open_session
from tests.conftest import PATIENCE_S, wait_until
from tests.deploy.compose.conftest import SLEEP, Laboratory


def test_state_is_queried_and_changes_are_published(laboratory: Laboratory) -> None:
    view = laboratory.up({"x": {"command": SLEEP}})
    laboratory.phase("x", "ready")
    with open_session(BusAddress(view.folder, view.namespace), "looker") as session:
        replies = [reply.ok for reply in session.get(STATE, timeout=PATIENCE_S) if reply.ok is not None]
        told = StackView.model_validate_json(replies[0].payload.to_bytes())
        assert [(one.name, one.phase) for one in told.processes] == [("x", "ready")]
        heard: list[zenoh.Sample] = []
        with session.declare_subscriber(changes_key("*"), heard.append):

            def restarted() -> bool:
                laboratory.ask("restart", "x")
                return len(heard) > 3

            wait_until(restarted, PATIENCE_S)
        changes = [ProcessView.model_validate_json(sample.payload.to_bytes()) for sample in heard]
        assert {change.name for change in changes} == {"x"}
        assert {"stopping", "starting"} <= {change.phase for change in changes}


def test_supervisors_find_each_other_over_an_endpoint(laboratory: Laboratory) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    # The one that connects comes first: it must go on trying.
    first = laboratory.up({"x": {"command": SLEEP}}, name="first", bus={"connect": [endpoint]})
    second = laboratory.up({"y": {"command": SLEEP}}, name="second", bus={"listen": [endpoint]})
    for view in (first, second):
        wait_until(lambda folder=view.folder: len(all_stacks(folder)) == 2, PATIENCE_S)  # type: ignore[misc]
    assert [view.name for view in all_stacks(first.folder)] == ["first", "second"]


def test_over_tls_only_who_has_a_certificate_is_let_in(laboratory: Laboratory) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"tls/localhost:{free.getsockname()[1]}"
    ours = write_certificates(laboratory.folder / "ours", [Machine("localhost"), Machine("other")], 30)
    (theirs,) = write_certificates(laboratory.folder / "theirs", [Machine("localhost")], 30)
    shutil.copy(ours[0] / AUTHORITY, theirs / AUTHORITY)
    processes = {"x": {"command": SLEEP}}
    first = laboratory.up(processes, name="first", bus={"listen": [endpoint], "tls": str(ours[0])})
    stranger = laboratory.up(processes, name="stranger", bus={"connect": [endpoint], "tls": str(theirs)})
    second = laboratory.up(processes, name="second", bus={"connect": [endpoint], "tls": str(ours[1])})
    wait_until(lambda: len(all_stacks(first.folder)) > 1, PATIENCE_S)
    assert [view.name for view in all_stacks(second.folder)] == ["first", "second"]
    assert [view.name for view in all_stacks(stranger.folder)] == ["stranger"]


def test_a_supervisor_listens_on_no_network_by_itself(laboratory: Laboratory) -> None:
    view = laboratory.up({"x": {"command": SLEEP}})
    laboratory.phase("x", "ready")
    held = _descriptors(view.pid)
    inodes = {line.split()[9] for kind in ("tcp", "tcp6", "udp", "udp6") for line in _sockets(kind)}
    assert not {f"socket:[{inode}]" for inode in inodes} & held


def _descriptors(pid: int) -> set[str]:
    """What a process has open; it may be closing our last connection meanwhile."""
    found = set()
    for entry in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):
            found.add(entry.readlink().name)
    return found


def _sockets(kind: str) -> list[str]:
    return Path(f"/proc/net/{kind}").read_text().splitlines()[1:]
