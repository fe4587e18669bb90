"""What pages are sent: nothing that has not changed, and nothing while nobody looks at them."""

from contextlib import closing

import pytest
from playwright.sync_api import Page, WebSocket, expect

from dashboard.campaigns.spec import Arm, CampaignSpec
from dashboard.campaigns.store import Store
from services.bus.mission import FaultSpec
from tests.dashboard.api.conftest import Serving
from tests.dashboard.campaigns.test_store import outcome
from tests.dashboard.web.conftest import Looking

SPEC = CampaignSpec(
    name="still", runs=4, arms=(Arm(name="golden"), Arm(name="flip", fault=FaultSpec(target="pid")))
)
SETTLED_MS = 4000
"""Several times as long as a page waits before it looks again."""


def stored(service: Serving) -> str:
    """The label of a campaign with a result, which nobody flies."""
    with closing(Store(service.said.parent)) as store:
        found = store.create(SPEC)
        states = store.states(found)
        store.write(found, states, [], {next(iter(states.runs)): outcome()})
        return found.label


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


@pytest.mark.parametrize("path", ["/", "/campaigns/{label}"])
def test_a_page_on_which_nothing_changes_is_sent_nothing(
    service: Serving, looking: Looking, path: str
) -> None:
    label = stored(service)
    sent = updates(looking.page)
    page = looking.goto(service.address, path.format(label=label))
    expect(page.locator(".words").first).to_contain_text("of 8 flown")
    expect(page.get_by_text("Being reckoned.")).to_be_hidden()
    page.wait_for_timeout(SETTLED_MS)
    sent.clear()
    page.wait_for_timeout(SETTLED_MS)
    assert sent == []


def test_a_page_that_is_not_in_front_waits_until_it_is(service: Serving, looking: Looking) -> None:
    page = looking.goto(service.address)
    expect(page.get_by_role("link", name="New campaign")).to_be_visible()
    be_in_front(page, front=False)
    page.wait_for_timeout(SETTLED_MS)
    label = stored(service)
    page.wait_for_timeout(SETTLED_MS)
    expect(page.get_by_role("link", name=label)).to_have_count(0)
    be_in_front(page, front=True)
    expect(page.get_by_role("link", name=label)).to_be_visible()
