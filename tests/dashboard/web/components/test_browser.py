"""What pages are sent: nothing that has not changed, and nothing while nobody looks at them."""

import pytest
from playwright.sync_api import Page, WebSocket, expect

from dashboard.campaigns.spec import Arm, CampaignSpec
from services.models.faults.specification import FaultSpec
from tests.dashboard.api.conftest import Serving
from tests.dashboard.web.conftest import Looking
from tests.dashboard.web.stored import stored

SPEC = CampaignSpec(
    name="still", runs=4, arms=(Arm(name="golden"), Arm(name="flip", fault=FaultSpec(target="pid")))
)
SETTLED_MS = 4000
"""Several times as long as a page waits before it looks again."""


def updates(page: Page) -> list[str]:
    """Changes of elements that a page is sent from now on."""
    seen: list[str] = []

    def frame(sent: str | bytes) -> None:
        if isinstance(sent, str) and sent.startswith('42["update"'):
            seen.append(sent)

    def opened(socket: WebSocket) -> None:
        socket.on("framereceived", frame)

    page.on("websocket", opened)
    return seen


def be_in_front(page: Page, front: bool) -> None:
    """As if another tab were chosen, or this one again."""
    hidden = "false" if front else "true"
    page.evaluate(
        f"Object.defineProperty(document, 'hidden', {{value: {hidden}, configurable: true}});"
        "document.dispatchEvent(new Event('visibilitychange'))"
    )


@pytest.mark.soak
def test_a_page_on_which_nothing_changes_is_sent_nothing(service: Serving, looking: Looking) -> None:
    label = stored(service, SPEC)
    sent = updates(looking.page)
    page = looking.goto(service.address)
    other = looking.another()
    sent_other = updates(other.page)
    other.goto(service.address, f"/campaigns/{label}")
    for one in (page, other.page):
        expect(one.locator(".words").first).to_have_text("8 of 8 flown")
        expect(one.get_by_text("Being computed.")).to_be_hidden()
    assert sent_other, "what it shows was sent"
    page.wait_for_timeout(SETTLED_MS)
    sent.clear()
    sent_other.clear()
    page.wait_for_timeout(SETTLED_MS)
    assert (sent, sent_other) == ([], [])


@pytest.mark.soak
def test_a_page_that_is_not_in_front_waits_until_it_is(service: Serving, looking: Looking) -> None:
    page = looking.goto(service.address)
    expect(page.get_by_role("link", name="New campaign")).to_be_visible()
    be_in_front(page, front=False)
    front = looking.another().goto(service.address)
    label = stored(service, SPEC)
    expect(front.get_by_role("link", name=label)).to_be_visible()
    page.wait_for_timeout(SETTLED_MS / 2)
    expect(page.get_by_role("link", name=label)).to_have_count(0)
    be_in_front(page, front=True)
    expect(page.get_by_role("link", name=label)).to_be_visible()
