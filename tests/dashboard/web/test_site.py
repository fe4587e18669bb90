"""Pages stand beside the API, and cost nothing where they are not served."""

import subprocess
import sys

import httpx

from tests.dashboard.api.conftest import PATIENCE_S, Serving


def test_the_api_answers_its_own_paths_also_where_there_is_nothing(service: Serving) -> None:
    for method, path, status in (("GET", "/api/v1/none", 404), ("PUT", "/api/v1/campaigns", 405)):
        answer = httpx.request(method, service.address + path, timeout=PATIENCE_S)
        assert (answer.status_code, answer.headers["content-type"]) == (status, "application/problem+json")
    page = httpx.get(f"{service.address}/none", timeout=PATIENCE_S)
    assert (page.status_code, page.headers["content-type"]) == (404, "text/html; charset=utf-8")


def test_a_command_that_serves_nothing_loads_no_pages() -> None:
    told = "import sys, dashboard.cli, dashboard.api.app; print('nicegui' in sys.modules)"
    assert subprocess.check_output([sys.executable, "-c", told], text=True) == "False\n"
