"""A real browser: Debian's Chromium, steered by Playwright. Without it these tests fail."""

import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, ConsoleMessage, Page, Request, expect, sync_playwright

from tests.dashboard.api.conftest import PATIENCE_S, Serving, client, serving

__all__ = ["PATIENCE_MS", "Looking", "browser", "client", "looking", "service"]

WEBGL = ("--enable-unsafe-swiftshader",)
"""Three dimensions are drawn by the processor: there may be no graphics card."""

DRIVER = "GL Driver Message"
"""Of the browser about itself: it reads pictures back from the processor that drew them."""

PATIENCE_MS = 1e3 * PATIENCE_S
expect.set_options(timeout=PATIENCE_MS)


@pytest.fixture(scope="package")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    """One service for all tests of pages: it takes seconds to start. Each leaves nothing that flies."""
    with serving(tmp_path_factory.mktemp("service")) as one:
        yield one


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """One browser for a file of tests."""
    path = shutil.which("chromium")
    if path is None:
        pytest.fail("no chromium in PATH: apt-get install chromium", pytrace=False)
    # Chromium has no sandbox for root, as whom CI runs.
    sandbox = ["--no-sandbox"] if os.geteuid() == 0 else []
    with sync_playwright() as playwright:
        options = [*sandbox, "--disable-dev-shm-usage", *WEBGL]
        opened = playwright.chromium.launch(executable_path=path, args=options)
        yield opened
        opened.close()


@dataclass
class Looking:
    """A page, what its browser complained about, and what it asked of other hosts."""

    page: Page
    complaints: list[str] = field(default_factory=list)
    elsewhere: list[str] = field(default_factory=list)
    hosts: set[str] = field(default_factory=set)
    expected: tuple[str, ...] = ()
    """Parts of what the browser says of something that a test does on purpose."""

    def goto(self, address: str, path: str = "/") -> Page:
        """Open a page of the service at ``address`` and wait until it is connected."""
        self.hosts.add(urlsplit(address).netloc)
        self.page.goto(f"{address}{path}")
        self.await_connection()
        return self.page

    def await_connection(self) -> None:
        """Wait until the page that is shown listens to clicks."""
        self.page.wait_for_function(
            "window.socket?.connected === true || !window.createApp", timeout=PATIENCE_MS
        )

    def another(self) -> "Looking":
        """A second page of the same browser; what goes wrong there counts here."""
        one = replace(self, page=self.page.context.new_page())
        one.listen()
        return one

    def listen(self) -> None:
        """Note what goes wrong from now on."""
        self.page.on("console", self._console)
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", self._request)

    def _console(self, message: ConsoleMessage) -> None:
        known = (DRIVER, *self.expected)
        if message.type in ("error", "warning") and not any(part in message.text for part in known):
            self.complaints.append(f"{message.type}: {message.text} ({message.location['url']})")

    def _request(self, request: Request) -> None:
        parts = urlsplit(request.url)
        if parts.scheme not in ("data", "blob") and parts.netloc not in self.hosts:
            self.elsewhere.append(request.url)


@pytest.fixture
def looking(browser: Browser) -> Iterator[Looking]:
    """A page that asks no other host for anything, and of which the browser has nothing to complain."""
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    context.set_default_timeout(PATIENCE_MS)
    one = Looking(context.new_page())
    one.listen()
    yield one
    context.close()
    assert not one.elsewhere
    assert not one.complaints
