"""Who is let in: this machine alone, elsewhere who bears the token; no page of another origin."""

import asyncio
import os
import stat
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from types import MappingProxyType

import pytest
from click.testing import CliRunner
from fastapi import FastAPI
from starlette.types import Message

from dashboard.api.app import MOST_BODY_BYTES
from dashboard.api.security import new_token, token_hash
from dashboard.campaigns.store.store import Store
from dashboard.cli import zenfi
from dashboard.server import serve
from deploy.errors import BadSpecError
from tests.dashboard.api.asking import CAMPAIGNS, HERE, ask, make


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with closing(Store(tmp_path)) as opened:
        yield opened


def open_websocket(
    app: FastAPI, origin: str, more: Mapping[str, str] = MappingProxyType({})
) -> list[Message]:
    """What the service sends to a page of ``origin`` that opens a WebSocket."""
    sent: list[Message] = []
    headers = [(b"host", b"localhost:8300"), (b"origin", origin.encode())]
    headers += [(name.encode(), value.encode()) for name, value in more.items()]
    scope = {
        "type": "websocket",
        "path": "/api/v1/ws",
        "query_string": b"",
        "headers": headers,
        "scheme": "ws",
        "client": ("127.0.0.1", 40_000),
        "server": ("127.0.0.1", 8300),
    }

    async def receive() -> Message:
        return {"type": "websocket.connect"}

    async def send(message: Message) -> None:
        sent.append(message)

    asyncio.run(app({**scope, "subprotocols": []}, receive, send))
    return sent


def test_on_loopback_only_names_of_this_machine_are_answered(store: Store) -> None:
    app = make(store)
    for host in ("localhost", "localhost:8300", "127.0.0.1:8300", "[::1]:8300"):
        assert ask(app, CAMPAIGNS, headers={"Host": host}).status_code == 200
    for host in ("evil.example", "evil.example:8300", "127.0.0.1.evil.example", "", "localhost@evil.example"):
        answer = ask(app, CAMPAIGNS, headers={"Host": host})
        assert answer.status_code == 403, host
        assert answer.headers["content-type"] == "application/problem+json"


def test_a_page_of_another_origin_is_refused(store: Store) -> None:
    app = make(store)
    assert ask(app, CAMPAIGNS, headers={"Origin": HERE}).status_code == 200
    for origin in ("http://evil.example", "http://localhost:9999", "null", ""):
        assert ask(app, f"{CAMPAIGNS}/x-1/cancel", "POST", headers={"Origin": origin}).status_code == 403
        assert [message["type"] for message in open_websocket(app, origin)] == ["websocket.close"]
    accepted, ended = open_websocket(app, HERE)
    assert (accepted["type"], ended["code"]) == ("websocket.accept", 1001)


@pytest.mark.parametrize("uid", [os.getuid() + 1, None])
def test_on_loopback_other_users_must_bear_the_token(store: Store, uid: int | None) -> None:
    app = make(store, uid=uid)
    for path, method in ((CAMPAIGNS, "GET"), (CAMPAIGNS, "POST"), ("/metrics", "GET"), ("/", "GET")):
        answer = ask(app, path, method, json={"preset": "demo"})
        assert answer.status_code == 401
        assert "another user" in answer.json()["detail"]
    assert [one["type"] for one in open_websocket(app, HERE)] == ["websocket.close"]
    assert ask(app, "/health").status_code == 200
    token = new_token(store.folder)
    app = make(store, token_hash(store.folder), uid=uid)
    assert ask(app, CAMPAIGNS, headers={"Authorization": f"Bearer {token}"}).json()["campaigns"] == []
    assert ask(app, CAMPAIGNS, headers={"Authorization": f"Bearer {token}x"}).status_code == 401


def test_without_a_token_an_empty_one_lets_nobody_in(store: Store) -> None:
    app = make(store, uid=None)
    for headers in ({"Authorization": "Bearer "}, {"Cookie": "zenfi_token="}):
        assert ask(app, CAMPAIGNS, headers=headers).status_code == 401


def test_beyond_this_machine_requests_must_bear_the_token(store: Store) -> None:
    token, elsewhere = new_token(store.folder), "http://lab.example"
    app = make(store, token_hash(store.folder), loopback=False)
    assert (
        ask(app, CAMPAIGNS, base=elsewhere, headers={"Authorization": f"Bearer {token}"}).status_code == 200
    )
    for wrong in ("", "Bearer ", f"Basic {token}", f"Bearer {token}x", token):
        answer = ask(app, CAMPAIGNS, base=elsewhere, headers={"Authorization": wrong})
        assert (answer.status_code, answer.headers["www-authenticate"]) == (401, "Bearer")
    assert ask(app, "/metrics", base=elsewhere, headers={}).status_code == 401
    assert ask(app, "/health", base=elsewhere, headers={}).status_code == 200


def test_a_token_is_told_once_and_kept_as_a_hash_for_its_owner_alone(tmp_path: Path) -> None:
    said = CliRunner().invoke(zenfi, ["token", "new", "--store", str(tmp_path)])
    token = said.stdout.strip()
    assert len(token) == 43
    kept = tmp_path / "token.sha256"
    assert stat.S_IMODE(kept.stat().st_mode) == 0o600
    assert token not in kept.read_text()
    before = token_hash(tmp_path)
    assert new_token(tmp_path) != token
    assert token_hash(tmp_path) != before
    kept.chmod(0o644)
    with pytest.raises(BadSpecError, match="others may read"):
        token_hash(tmp_path)


@pytest.mark.process
def test_without_a_token_nothing_listens_beyond_this_machine(tmp_path: Path) -> None:
    with pytest.raises(BadSpecError, match="zenfi token new"):
        serve(str(tmp_path), "0.0.0.0", 1, None)  # noqa: S104 - it must not


def test_beyond_this_machine_a_websocket_must_bear_the_token(store: Store) -> None:
    token = new_token(store.folder)
    app = make(store, token_hash(store.folder), loopback=False)
    for headers in ({}, {"authorization": f"Bearer {token}x"}, {"cookie": "zenfi_token=x"}):
        assert [one["type"] for one in open_websocket(app, HERE, headers)] == ["websocket.close"]
    for headers in ({"authorization": f"Bearer {token}"}, {"cookie": f"zenfi_token={token}"}):
        assert open_websocket(app, HERE, headers)[0]["type"] == "websocket.accept"


@pytest.mark.parametrize("mode", [0o640, 0o620, 0o610, 0o604, 0o602, 0o601])
def test_a_token_file_that_anybody_else_may_use_is_refused(tmp_path: Path, mode: int) -> None:
    new_token(tmp_path)
    (tmp_path / "token.sha256").chmod(mode)
    with pytest.raises(BadSpecError, match="others may read"):
        token_hash(tmp_path)


def test_a_body_that_is_too_large_is_refused_whatever_it_says_of_its_length(store: Store) -> None:
    app = make(store)
    large = b"[" * (MOST_BODY_BYTES + 1)

    async def without_a_length() -> AsyncIterator[bytes]:
        for first in range(0, len(large), 100_000):
            yield large[first : first + 100_000]

    for content in (large, without_a_length()):
        answer = ask(app, CAMPAIGNS, "POST", content=content, headers={"Content-Type": "application/json"})
        assert answer.status_code == 413
        assert str(MOST_BODY_BYTES) in answer.json()["detail"]


def test_a_body_that_says_that_it_is_too_large_is_not_read(store: Store) -> None:
    app, sent = make(store), list[Message]()

    async def receive() -> Message:
        raise AssertionError("the body was read")

    async def send(message: Message) -> None:
        sent.append(message)

    length = str(MOST_BODY_BYTES + 1).encode()
    headers = [
        (b"host", b"localhost:8300"),
        (b"content-length", length),
        (b"content-type", b"application/json"),
    ]
    scope = {"type": "http", "method": "POST", "path": CAMPAIGNS, "query_string": b"", "headers": headers}
    scope |= {"scheme": "http", "http_version": "1.1", "client": ("::1", 40_000), "server": ("::1", 8300)}
    asyncio.run(app(scope, receive, send))
    assert sent[0]["status"] == 413
