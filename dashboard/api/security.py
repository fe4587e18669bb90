"""Who may ask: on loopback the user who serves, else who has the token; never a page of another origin."""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import os
import secrets
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection
from starlette.responses import RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from dashboard.api.problems import answer
from deploy.errors import BadSpecError
from services.system.peers import Endpoint, peer_uid

TOKEN_FILE = "token.sha256"  # noqa: S105 - a file's name
OPEN = ("/health", "/ready", "/login", "/favicon.ico")
"""Paths that need no token: they tell nothing."""

COOKIE = "zenfi_token"
"""How a browser bears the token, once it was given at ``/login``."""


def new_token(folder: Path) -> str:
    """Make the store's token, in place of an older one. Only its hash is kept, for the user alone.

    A token has 256 random bits, so a plain hash cannot be guessed back.
    """
    token = secrets.token_urlsafe(32)
    folder.mkdir(parents=True, exist_ok=True)
    draft = folder / f".{TOKEN_FILE}.part"
    descriptor = os.open(draft, os.O_CREAT | os.O_WRONLY | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    with open(descriptor, "w") as file:  # noqa: PTH123 - of a descriptor
        os.fchmod(descriptor, 0o600)
        file.write(_hash(token) + "\n")
    draft.replace(folder / TOKEN_FILE)
    return token


def token_hash(folder: Path) -> str:
    """The hash of the store's token, empty if there is none.

    :raises BadSpecError: if others may read or change it.
    """
    path = folder / TOKEN_FILE
    try:
        mode, text = path.stat().st_mode, path.read_text().strip()
    except FileNotFoundError:
        return ""
    if mode & 0o077:
        message = f"{path}: others may read it; make a new one: zenfi token new"
        raise BadSpecError(message)
    return text


UserOf = Callable[[Endpoint, Endpoint], int | None]
"""The user whose socket is at the first endpoint, connected to the second; None if that cannot be told."""


def is_loopback(host: str) -> bool:
    """Whether only programs on this machine can reach an address."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


def bears(token: str, hashed: str) -> bool:
    """Whether ``token`` is the one of that hash."""
    return hmac.compare_digest(_hash(token), hashed)


def _hash(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()


class AccessGuard:
    """Lets a request in, or answers it with 401 or 403.

    Requests must bear the token of that hash (none does if it is empty). On ``loopback`` those of our own
    user need none: ``user_of`` tells whose a connection is. There the Host must be a name of this machine,
    too: else a page whose name was bound to 127.0.0.1 after it was loaded could speak with us (DNS
    rebinding). What comes from a page (Origin) must come from one of ours. A browser that has no token is
    led to where it can be given.
    """

    def __init__(self, app: ASGIApp, token: str, *, loopback: bool, user_of: UserOf = peer_uid) -> None:
        self._app, self._token, self._loopback, self._user_of = app, token, loopback, user_of

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        refused = self._refusal(scope) if scope["type"] in ("http", "websocket") else None
        if refused is None:
            await self._app(scope, receive, send)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008, "reason": refused[1]})
        elif refused[0] == 401 and "text/html" in Headers(scope=scope).get("accept", ""):
            await RedirectResponse("/login", 303)(scope, receive, send)
        else:
            status, detail = refused
            headers = {"WWW-Authenticate": "Bearer"} if status == 401 else None
            await answer(status, detail, headers=headers)(scope, receive, send)

    def _refusal(self, scope: Scope) -> tuple[int, str] | None:
        headers = Headers(scope=scope)
        host, origin = headers.get("host", ""), headers.get("origin")
        if self._loopback and not is_loopback(urlsplit(f"//{host}").hostname or ""):
            return 403, f"Host {host!r} is no name of this machine: use 127.0.0.1 or localhost"
        if origin is not None and urlsplit(origin).netloc != host:
            return 403, f"Origin {origin!r} is not this service"
        if scope["path"] in OPEN or self._bears_token(scope, headers) or self._is_our_user(scope):
            return None
        whose = "another user of this machine serves here: it " if self._loopback else ""
        return 401, f"{whose}needs the header Authorization: Bearer TOKEN; zenfi token new makes one"

    def _bears_token(self, scope: Scope, headers: Headers) -> bool:
        scheme, _, token = headers.get("authorization", "").partition(" ")
        if scheme.lower() != "bearer":
            token = HTTPConnection(scope).cookies.get(COOKIE, "")
        return bears(token.strip(), self._token)

    def _is_our_user(self, scope: Scope) -> bool:
        """Asked for each request: a connection's port may be another user's a moment later."""
        return self._loopback and self._user_of(tuple(scope["client"]), tuple(scope["server"])) == os.getuid()


class BodyLimit:
    """Refuses bodies of more than ``most`` bytes, whatever they say of their length."""

    def __init__(self, app: ASGIApp, most: int) -> None:
        self._app, self._most = app, most

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on as long as it is short enough."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        told = Headers(scope=scope).get("content-length", "0")
        if told.isdecimal() and int(told) > self._most:
            await answer(413, self._refusal)(scope, receive, send)
            return
        got = 0

        async def counted() -> Message:
            nonlocal got
            message = await receive()
            got += len(message.get("body", b""))
            if got > self._most:
                raise HTTPException(413, self._refusal)
            return message

        await self._app(scope, counted, send)

    @property
    def _refusal(self) -> str:
        return f"the body is larger than {self._most} bytes"
