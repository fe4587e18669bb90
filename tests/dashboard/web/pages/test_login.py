"""Beyond this machine nothing is shown or done without the token, and the browser keeps it from scripts."""

from collections.abc import Iterator
from contextlib import closing

import httpx
import pytest
from playwright.sync_api import expect

from dashboard.api.security import COOKIE, new_token
from dashboard.campaigns.spec import Arm, CampaignSpec
from dashboard.campaigns.store.store import Store
from tests.dashboard.api.conftest import PATIENCE_S, Serving, serving
from tests.dashboard.web.conftest import Looking

HTML = {"Accept": "text/html"}


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Serving, str]]:
    """A service that others could reach, and its token; it has a campaign."""
    folder = tmp_path_factory.mktemp("guarded")
    token = new_token(folder)
    with closing(Store(folder)) as store:
        store.create(CampaignSpec(name="secret", runs=1, arms=(Arm(name="golden"),)))
    with serving(folder, "--host", "0.0.0.0") as one:  # noqa: S104 - what is tested
        yield one, token


def test_without_the_token_pages_lead_to_where_it_is_given(guarded: tuple[Serving, str]) -> None:
    one, token = guarded
    assert httpx.get(f"{one.address}/favicon.ico", timeout=PATIENCE_S).status_code == 200  # that of /login
    for path in ("/", "/campaigns/secret-1", "/new", "/studies"):
        answer = httpx.get(one.address + path, headers=HTML, timeout=PATIENCE_S)
        assert (answer.status_code, answer.headers["location"]) == (303, "/login")
        assert "secret" not in answer.text
    for path in ("/_nicegui_ws/socket.io/?EIO=4&transport=polling", "/api/v1/campaigns"):
        assert httpx.get(one.address + path, timeout=PATIENCE_S).status_code == 401
        assert httpx.get(one.address + path, cookies={COOKIE: "wrong"}, timeout=PATIENCE_S).status_code == 401
    assert (
        httpx.get(f"{one.address}/api/v1/campaigns", cookies={COOKIE: token}, timeout=PATIENCE_S).status_code
        == 200
    )


def test_the_token_is_given_once_and_no_script_reads_it(
    guarded: tuple[Serving, str], looking: Looking
) -> None:
    one, token = guarded
    page = looking.page
    looking.hosts.add(one.address.removeprefix("http://"))
    page.goto(f"{one.address}/campaigns/secret-1")
    assert page.url == f"{one.address}/login"
    page.get_by_label("Token").fill("wrong")
    looking.expected = ("401",)
    page.get_by_role("button", name="Enter").click()
    expect(page.get_by_role("alert")).to_have_text("That is not the token.")

    page.get_by_label("Token").fill(token)
    page.get_by_role("button", name="Enter").click()
    page.wait_for_url(f"{one.address}/")
    page.wait_for_function("window.did_handshake === true")
    expect(page.get_by_role("link", name="secret-1")).to_be_visible()
    assert token not in page.evaluate("document.cookie")
    (cookie,) = [one for one in page.context.cookies() if one["name"] == COOKIE]
    assert (cookie["httpOnly"], cookie["sameSite"]) == (True, "Strict")
    page.get_by_role("button", name="delete").click()
    page.get_by_role("button", name="Delete", exact=True).click()
    expect(page.get_by_text("No campaigns yet.")).to_be_visible()


def test_pages_of_others_can_neither_log_in_nor_frame_ours(guarded: tuple[Serving, str]) -> None:
    one, token = guarded
    answer = httpx.post(
        f"{one.address}/login", data={"token": token}, headers={"Origin": "http://evil.example"}
    )
    assert answer.status_code == 403
    assert "set-cookie" not in answer.headers
    shown = httpx.get(one.address, cookies={COOKIE: token}, headers=HTML, timeout=PATIENCE_S)
    assert "frame-ancestors 'none'" in shown.headers["content-security-policy"]
    assert "default-src 'self'" in shown.headers["content-security-policy"]
