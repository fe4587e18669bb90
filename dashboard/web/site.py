"""The pages, mounted on the application of the API: one port, one gate, one process."""

from __future__ import annotations

from fastapi import FastAPI, Request, Response
from fastapi.exception_handlers import http_exception_handler
from fastapi.exceptions import RequestValidationError
from nicegui import Client, ui
from nicegui import app as pages
from nicegui.client import templates
from starlette.exceptions import HTTPException
from starlette.routing import Match, Mount
from starlette.types import Message, Receive, Scope, Send

from dashboard.api.service import Service
from dashboard.web.charts import flight_style
from dashboard.web.components import frame
from dashboard.web.pages import (
    campaign,
    compare,
    home,
    live,
    login,
    new,
    program_study,
    programs,
    run,
    studies,
    system,
)

PAGES = (home, new, campaign, run, live, programs, program_study, compare, studies, system)
"""A module per page; each has ``register(service)``."""

NOT_PAGES = ("/api/", "/health", "/ready", "/metrics")
"""What the API answers itself, also that there is no such path."""

RECONNECT_S = 20.0
"""What the server keeps a page's state for, while its browser is away.

A browser that draws for some seconds on a busy machine answers as late: its page is kept, not loaded anew.
"""

POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; "
    "form-action 'self'; frame-ancestors 'none'; base-uri 'self'"
)
"""Nothing from another host, and no page of others around ours. NiceGUI's scripts stand in the page."""


def mount(app: FastAPI, service: Service) -> None:
    """Have ``app`` answer with pages what is no path of the API. Once a process: NiceGUI is one."""
    app.include_router(login.router)
    for page in PAGES:
        page.register(service)
    pages.add_exception_handler(404, _missing)
    pages.add_exception_handler(RequestValidationError, _missing)
    # NiceGUI knows languages of countries only, and loads texts of its own for each.
    templates.context_processors.append(lambda _: {"html_lang": "en"})
    frame.install()
    flight_style.install()
    ui.run_with(
        app,
        title="ZenFI",
        favicon=frame.ICON,
        dark=None,
        tailwind=False,
        reconnect_timeout=RECONNECT_S,
        show_welcome_message=False,
    )
    mounted = app.router.routes.pop()
    assert isinstance(mounted, Mount)  # noqa: S101 - just made
    app.router.routes.append(_Pages("/", app=mounted.app, name="pages"))


async def _missing(request: Request, error: Exception) -> Response:
    """There is no such page, or none at such a number: NiceGUI's own says so without a way on."""
    if request.url.path.startswith("/_nicegui") and isinstance(error, HTTPException):
        return await http_exception_handler(request, error)
    with Client(ui.page(""), request=request) as client, frame.frame("No such page"):
        frame.absent("There is no page at this address.", "Those that there are stand at the top.")
    return client.build_response(request, 404)


class _Pages(Mount):
    """Everything but the API's paths; answers with the policy."""

    def matches(self, scope: Scope) -> tuple[Match, Scope]:
        """Whether a path is the address of a page."""
        if scope.get("path", "").startswith(NOT_PAGES):
            return Match.NONE, {}
        return super().matches(scope)

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer with the content security policy."""

        async def told(message: Message) -> None:
            if message["type"] == "http.response.start":
                kept = [(name, value) for name, value in message["headers"] if name != b"cache-control"]
                private = (b"cache-control", b"private, no-cache")
                static = scope["path"].startswith("/_nicegui/")
                message["headers"] = [
                    *(message["headers"] if static else [*kept, private]),
                    (b"content-security-policy", POLICY.encode()),
                    (b"referrer-policy", b"same-origin"),
                    (b"x-content-type-options", b"nosniff"),
                ]
            await send(message)

        await super().handle(scope, receive, told)
