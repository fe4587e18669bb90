"""Pages stand beside the API, and cost nothing where they are not served."""

import subprocess
import sys

import httpx

from tests.dashboard.api.conftest import PATIENCE_S, Serving
from tests.dashboard.web.conftest import Looking

BUSY_S = 15
"""Longer than a browser draws on a busy machine."""

SETTLED_MS = 3000
"""Long enough to connect again, and for a page that is loaded anew to be another."""


def test_the_api_answers_its_own_paths_also_where_there_is_nothing(service: Serving) -> None:
    for method, path, status in (("GET", "/api/v1/none", 404), ("PUT", "/api/v1/campaigns", 405)):
        answer = httpx.request(method, service.address + path, timeout=PATIENCE_S)
        assert (answer.status_code, answer.headers["content-type"]) == (status, "application/problem+json")
    page = httpx.get(f"{service.address}/none", timeout=PATIENCE_S)
    assert (page.status_code, page.headers["content-type"]) == (404, "text/html; charset=utf-8")


def test_a_command_that_serves_nothing_loads_no_pages() -> None:
    told = "import sys, dashboard.cli, dashboard.api.app; print('nicegui' in sys.modules)"
    assert subprocess.check_output([sys.executable, "-c", told], text=True) == "False\n"


def test_a_page_is_kept_while_its_browser_is_busy(service: Serving, looking: Looking) -> None:
    page = looking.goto(service.address)
    page.evaluate("window.before = 1")
    page.evaluate(f"() => {{ const until = Date.now() + {1000 * BUSY_S}; while (Date.now() < until); }}")
    page.wait_for_timeout(SETTLED_MS)
    looking.await_connection()
    assert page.evaluate("window.before") == 1
