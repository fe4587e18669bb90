"""What all pages have in common: header, ways to the other pages, light and dark, how trouble looks."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import ParamSpec, TypeVar

from fastapi.concurrency import run_in_threadpool
from nicegui import ui
from pydantic import ValidationError

from dashboard.api.problems import NotFoundError, NotReadyError
from dashboard.api.service import Service
from dashboard.campaigns.store.database import StoreError
from dashboard.campaigns.store.queries import CampaignEntry, UnknownCampaignError
from deploy.compose.folder import StackError
from deploy.errors import BadSpecError, InfrastructureError, one_line

NAVIGATION = (
    ("Campaigns", "/"),
    ("Live", "/live"),
    ("Programs", "/programs"),
    ("Compare", "/compare"),
    ("Studies", "/studies"),
    ("System", "/system"),
)

ALL_CAMPAIGNS = ("All campaigns", "/")
"""The way on from an address at which there is nothing."""

ICON = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 32 32"><rect width="32" height="32" rx="7" '
    'fill="#0072B2"/><path d="M18 4 8 18h7l-2 10 11-15h-8z" fill="#F0E442"/></svg>'
)

THEME = "zenfi_theme"
"""The cookie that holds what people chose: light or dark; without it, as their system is."""

REFUSED = (
    BadSpecError,
    StoreError,
    NotFoundError,
    NotReadyError,
    InfrastructureError,
    StackError,
    OSError,
)
"""What is told to people in a line; anything else is our bug, and in the log."""

P = ParamSpec("P")
T = TypeVar("T")


def install() -> None:
    """Add the styles that all pages share."""
    ui.add_css(Path(__file__).parents[1] / "style.css", shared=True)


@contextmanager
def frame(title: str, *, heading: bool = True) -> Iterator[None]:
    """A page: what is made inside is its content."""
    ui.colors(primary="#0072B2", negative="#B33A00", positive="#00704F")
    ui.page_title(f"{title} · ZenFI")
    path = ui.context.client.request.url.path
    with ui.header().classes("bar"), ui.element("nav").classes("ways").props('aria-label="Pages"'):
        ui.link("Skip to content", "#content").classes("skip")
        ui.link("ZenFI", "/").classes("brand")
        for name, way in NAVIGATION:
            link = ui.link(name, way).classes("way")
            if path == way or (way != "/" and path.startswith(f"{way}/")):
                link.props('aria-current="page"')
        ui.space()
        _theme()
    with ui.column().classes("content").props('id="content" role="main"'):
        if heading:
            ui.label(title).classes("title").props('role="heading" aria-level="1"')
        yield


def _theme() -> None:
    chosen = ui.context.client.request.cookies.get(THEME)
    ui.dark_mode({"dark": True, "light": False}.get(chosen or ""))

    async def turn() -> None:
        dark = not await ui.run_javascript("document.body.classList.contains('body--dark')")
        value = "dark" if dark else "light"
        # Loaded again, as charts take their colours from the page when they are drawn.
        cookie = f"{THEME}={value}; path=/; max-age=31536000; samesite=strict"
        ui.run_javascript(f"document.cookie = '{cookie}'; location.reload()")

    ui.button(icon="contrast", on_click=turn).props('flat round dense color=white aria-label="Light or dark"')


# -- states of a page --------------------------------------------------------------------------------


def nothing(what: str, remedy: str, way: tuple[str, str] | None = None) -> None:
    """There is nothing to show yet; ``remedy`` says what to do, ``way`` is a link (name, path) to where."""
    with ui.column().classes("state").props('role="status"'):
        ui.label(what).classes("state-title")
        ui.label(remedy)
        if way is not None:
            ui.link(*way)


def trouble(what: str, remedy: str = "", way: tuple[str, str] | None = None) -> None:
    """Something is wrong; ``remedy`` says what to do, ``way`` is a link (name, path) to where."""
    with ui.column().classes("state trouble").props('role="alert"'):
        ui.label(what).classes("state-title")
        if remedy:
            ui.label(remedy)
        if way is not None:
            ui.link(*way)


def absent(what: str, remedy: str, way: tuple[str, str] = ALL_CAMPAIGNS) -> None:
    """There is no such thing: the page says so and leads on, and its status is 404."""
    ui.context.client.status_code = 404
    trouble(what, remedy, way)


def section(title: str, note: str = "", anchor: str = "") -> ui.column:
    """A part of a page with a heading, to which ``#anchor`` leads; use as a context."""
    column = ui.column().classes("section").props(f"id={anchor}" if anchor else "")
    with column:
        ui.label(title).classes("heading").props('role="heading" aria-level="2"')
        if note:
            ui.label(note).classes("note")
    return column


# -- asking and acting -------------------------------------------------------------------------------


async def ask(question: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """The answer of what blocks (the store, files), beside the event loop."""
    return await run_in_threadpool(question, *args, **kwargs)


async def find(service: Service, label: str) -> CampaignEntry | None:
    """The campaign of that label; None after the page was told that there is none."""
    try:
        return await ask(service.store.find, label)
    except UnknownCampaignError as error:
        absent(plain(error), "It may have been deleted.")
    except REFUSED as error:
        trouble(str(error), "Load this page again once that is put right.")
    return None


def plain(error: Exception) -> str:
    """What is wrong, for people at a browser: they need not know where the store is."""
    return f"There is no campaign {error.label}." if isinstance(error, UnknownCampaignError) else str(error)


def told(action: Callable[P, Awaitable[None]]) -> Callable[P, Awaitable[None]]:
    """Have what people do say why it was refused."""

    @wraps(action)  # NiceGUI looks whether it takes the event
    async def acting(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            await action(*args, **kwargs)
        except ValidationError as error:
            refusal(one_line(error))
        except REFUSED as error:
            refusal(plain(error))

    return acting


def refusal(message: str) -> None:
    """Tell people that what they asked for cannot be done."""
    ui.notify(message, type="negative", position="top", timeout=10_000, close_button="Close", multi_line=True)


async def confirmed(question: str, action: str, about: str = "", color: str = "negative") -> bool:
    """Whether people mean it; ``about`` says more, ``color`` is that of the button that does it."""
    with ui.dialog() as dialog, ui.card():
        ui.label(question)
        if about:
            ui.label(about).classes("note")
        with ui.row().classes("actions"):
            ui.button("Back", on_click=lambda: dialog.submit(False)).props("flat autofocus")
            ui.button(action, on_click=lambda: dialog.submit(True), color=color)
    answer = await dialog
    dialog.delete()
    return bool(answer)
