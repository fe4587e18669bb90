"""Small parts of the pages that show flights. Texts go in as texts, never as markup."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime

from nicegui import ui


def minute(stamp: str) -> str:
    """A moment as people write it, to the minute."""
    return f"{datetime.fromisoformat(stamp).astimezone(UTC):%Y-%m-%d %H:%M} UTC"


def facts(told: Mapping[str, str]) -> None:
    """Names and what they are; what is empty is left out."""
    with ui.element("div").classes("facts"):
        for name, text in told.items():
            if text:
                ui.label(name).classes("fact-name")
                ui.label(text).classes("fact")


class Readings:
    """Numbers in a row, each with its name; ``show`` changes them."""

    def __init__(self, names: Sequence[str]) -> None:
        self._labels: dict[str, ui.label] = {}
        with ui.element("div").classes("readings"):
            for name in names:
                with ui.element("div").classes("reading"):
                    ui.label(name).classes("reading-name")
                    self._labels[name] = ui.label("-").classes("reading-value")

    def show(self, values: Mapping[str, str]) -> None:
        """Change the values of these names."""
        for name, text in values.items():
            self._labels[name].set_text(text)


def table(
    caption: str, heads: Sequence[str], rows: Iterable[Sequence[str]], numbers: Sequence[str] = ()
) -> None:
    """A plain table; columns named in ``numbers`` are set to the right."""
    side = ["number" if head in numbers else "" for head in heads]
    with (
        ui.element("div").classes("scroll").props("tabindex=0 role=region") as region,
        ui.element("table").classes("plain").style(f"min-width: {min(len(heads) * 5, 48)}rem"),
    ):
        region.props["aria-label"] = caption
        with ui.element("thead"), ui.element("tr"):
            for head, place in zip(heads, side, strict=True):
                with ui.element("th").classes(place).props("scope=col"):
                    ui.label(head)
        with ui.element("tbody"):
            for row in rows:
                with ui.element("tr"):
                    for text, place in zip(row, side, strict=True):
                        with ui.element("td").classes(place):
                            ui.label(text)


def legend(keys: Mapping[str, str]) -> None:
    """What the colours of a picture stand for."""
    with ui.element("div").classes("legend"):
        for name, colour in keys.items():
            ui.label(name).classes("key").style(f"--key: {colour}")


def log(text: str, named: str) -> None:
    """Show the last lines of a log."""
    shown = ui.label(text).classes("log").props("tabindex=0 role=region")
    shown.props["aria-label"] = named
