"""What comes over TLS to a router: hosts do all, viewers see states, strangers get nothing."""

import json
import shutil
import socket
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh

from deploy.config.certificates import Machine, write_certificates
from deploy.config.link_security import AUTHORITY, access_control, tls_settings
from services.bus import announce
from services.bus.session import BusAddress, open_session
from tests.conftest import PATIENCE_S, wait_until

SPACE = "zenfi/stack/lab-1/test"
STATE = f"{SPACE}/supervisor/state"
ORDER = f"{SPACE}/order"
CONNECT_MS = 1000
ASK_S = 2.0


class Router:
    """A router that listens on TLS and on a Unix socket, and what a session beside it sees."""

    def __init__(self, folder: Path, held: ExitStack) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.endpoint = f"tls/127.0.0.1:{free.getsockname()[1]}"
        self.certificates = folder / "certificates"
        machines = [Machine("lab-1", ("127.0.0.1",)), Machine("lab-2"), Machine("laptop", role="viewer")]
        write_certificates(self.certificates, machines, 30)
        address = BusAddress(folder, SPACE)
        more = {
            **tls_settings(self.certificates / "lab-1"),
            **access_control(),
            "listen/endpoints": [address.endpoint("router"), self.endpoint],
        }
        self.session = held.enter_context(open_session(address, "router", router=True, more=more))
        self.beside = held.enter_context(open_session(address, "beside"))
        self.heard: list[str] = []
        self.announced: list[str] = []
        self.declared = [
            self.session.declare_queryable(
                "supervisor/state", lambda query: query.reply("supervisor/state", "up")
            ),
            self.session.declare_queryable("order", lambda query: query.reply("order", "done")),
            self.beside.declare_subscriber("flight", lambda one: self.heard.append(one.payload.to_string())),
            self.beside.liveliness().declare_subscriber(
                announce.ALL, lambda one: self.announced.append(str(one.key_expr))
            ),
            self.beside.liveliness().declare_token("node/beside/1/1/1/boot"),
        ]

    def join(self, settings: dict[str, object]) -> zenoh.Session:
        """A session of another machine, with these settings.

        :raises zenoh.ZError: if the router does not let it in.
        """
        config = zenoh.Config()
        common: dict[str, object] = {
            "mode": "client",
            "connect/endpoints": [self.endpoint],
            "connect/timeout_ms": CONNECT_MS,
            "connect/exit_on_failure": True,
            "scouting/multicast/enabled": False,
        }
        for key, value in (common | settings).items():
            config.insert_json5(key, json.dumps(value))
        return zenoh.open(config)

    def join_as(self, name: str) -> zenoh.Session:
        return self.join(tls_settings(self.certificates / name))


@pytest.fixture
def router() -> Iterator[Router]:
    # pytest's folders have paths too long for sockets.
    with tempfile.TemporaryDirectory() as name, ExitStack() as held:
        yield Router(Path(name), held)


def answers(session: zenoh.Session, key: str) -> list[str]:
    return [one.ok.payload.to_string() for one in session.get(key, timeout=ASK_S) if one.ok is not None]


def told(router: Router, listener: list[str]) -> Callable[[], bool]:
    """Whether a change of a process, published anew each time, has come to a listener."""

    def came() -> bool:
        router.session.put("flight", "position")
        router.session.put("supervisor/processes/x", "change")
        return "change" in listener

    return came


def test_a_host_does_all(router: Router) -> None:
    with router.join_as("lab-2") as session:
        assert answers(session, ORDER) == ["done"]
        heard: list[str] = []
        with session.declare_subscriber("zenfi/**", lambda one: heard.append(one.payload.to_string())):
            came = told(router, heard)
            # The router may learn of the subscriber between the two that are published.
            wait_until(lambda: came() and "position" in heard, PATIENCE_S)
        token = session.liveliness().declare_token(f"{SPACE}/node/far/2/2/2/boot")
        session.put(f"{SPACE}/flight", "far")
        wait_until(lambda: router.heard[-1:] == ["far"], PATIENCE_S)
        wait_until(lambda: "node/far/2/2/2/boot" in router.announced, PATIENCE_S)
        del token


def test_a_viewer_sees_states_and_neither_orders_nor_publishes_nor_announces(router: Router) -> None:
    with router.join_as("laptop") as session:
        heard: list[str] = []
        keys = (f"{SPACE}/supervisor/processes/*", f"{SPACE}/flight")
        listeners = [
            session.declare_subscriber(key, lambda one: heard.append(one.payload.to_string())) for key in keys
        ]
        token = session.liveliness().declare_token(f"{SPACE}/node/false/2/2/2/boot")
        session.put(f"{SPACE}/flight", "false")
        assert answers(session, STATE) == ["up"]
        assert answers(session, ORDER) == []
        wait_until(told(router, heard), PATIENCE_S)
        assert "position" not in heard  # what it has published itself it does hear
        found = session.liveliness().get("zenfi/**", timeout=ASK_S)
        assert [str(one.ok.key_expr) for one in found if one.ok and "beside" in str(one.ok.key_expr)] == []
        # What comes over the same link after them has come.
        del listeners, token
    assert "false" not in router.heard
    assert router.announced == ["node/beside/1/1/1/boot"]


def test_a_stranger_is_not_let_in(router: Router, tmp_path: Path) -> None:
    ours = router.certificates / "lab-2" / AUTHORITY
    (foreign,) = write_certificates(tmp_path, [Machine("lab-2")], 30)
    with pytest.raises(zenoh.ZError):  # does not trust us
        router.join(tls_settings(foreign))
    shutil.copy(ours, foreign / AUTHORITY)
    with pytest.raises(zenoh.ZError):  # trusts us, is of another authority
        router.join(tls_settings(foreign))
    with pytest.raises(zenoh.ZError):  # has none
        router.join({"transport/link/tls/root_ca_certificate": str(ours)})
    with pytest.raises(zenoh.ZError):  # does not speak TLS
        router.join({"connect/endpoints": [router.endpoint.replace("tls/", "tcp/")]})
    assert router.announced == ["node/beside/1/1/1/boot"]


def test_a_machine_that_is_not_the_one_that_was_called_is_not_spoken_to(router: Router) -> None:
    elsewhere = router.endpoint.replace(
        "127.0.0.1", "localhost"
    )  # the certificate is for lab-1 and 127.0.0.1
    with pytest.raises(zenoh.ZError):
        router.join(tls_settings(router.certificates / "lab-2") | {"connect/endpoints": [elsewhere]})
