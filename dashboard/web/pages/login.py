"""Where people give the token, once: their browser then bears it as a cookie that no script can read."""

from __future__ import annotations

from urllib.parse import parse_qs

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response

from dashboard.api.security import COOKIE, bears

router = APIRouter(include_in_schema=False)

_PAGE = """<!doctype html>
<html lang="en"><head><title>Token · ZenFI</title><meta name="viewport" content="width=device-width">
<style>
:root {{ color-scheme: light dark; font-family: sans-serif }}
main {{ max-width: 26rem; margin: 12vh auto; padding: 0 1rem }}
input, button {{ font: inherit; padding: .6rem; width: 100%; box-sizing: border-box; margin-top: .8rem }}
</style></head><body><main>
<h1>ZenFI</h1>
<p>This service listens beyond its machine, or another user of this machine runs it, so it needs its token.
Who runs it makes one with <code>zenfi token new</code>; a new one counts from the service's next start.</p>
<p role="alert"><strong>{said}</strong></p>
<form method="post" action="/login">
<label for="token">Token</label>
<input id="token" name="token" type="password" autocomplete="current-password" required autofocus>
<button type="submit">Enter</button>
</form></main></body></html>"""


@router.get("/login", response_class=HTMLResponse)
def ask_for_token() -> str:
    """Show the form that asks for the token."""
    return _PAGE.format(said="")


@router.post("/login")
async def take_token(request: Request) -> Response:
    """Take the token; the cookie goes to this service alone, and with no page of others."""
    given = parse_qs((await request.body()).decode(errors="replace")).get("token", [""])[0].strip()
    if not bears(given, request.app.state.token):
        return HTMLResponse(_PAGE.format(said="That is not the token."), 401)
    response = RedirectResponse("/", 303)
    secure = request.url.scheme == "https"
    response.set_cookie(COOKIE, given, httponly=True, samesite="strict", secure=secure)
    return response
