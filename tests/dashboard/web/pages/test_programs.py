"""Studies of programs in a browser: one is started from the form, watched, looked through and deleted."""

import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import expect

from deploy.kernel_study.file import kept_study
from tests.dashboard.api.conftest import Serving, serving
from tests.dashboard.web.conftest import Looking

RUNS = 40
WIDTHS = (390, 1024, 1440)
STUDY = f"""
runs = {RUNS}
[program]
command = ["/bin/echo", "<b>hello</b>"]
"""


@pytest.fixture(scope="module")
def striking(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    """A service whose owner allows one program."""
    folder = tmp_path_factory.mktemp("programs")
    (folder / "hello.toml").write_text(STUDY)
    with serving(tmp_path_factory.mktemp("service"), "--programs", str(folder)) as one:
        yield one


def test_a_study_is_started_watched_looked_through_and_deleted(striking: Serving, looking: Looking) -> None:
    page = looking.goto(striking.address)
    page.get_by_role("link", name="Programs").click()
    expect(page.get_by_text("/bin/echo <b>hello</b>", exact=True)).to_be_visible()
    expect(page.get_by_label("runs", exact=True)).to_have_value(str(RUNS))
    page.get_by_label("fault").fill("colour=red")
    page.get_by_role("button", name="Start").click()
    expect(page.get_by_text("fault.colour: Extra inputs are not permitted")).to_be_visible()
    page.get_by_label("fault").fill("bits=2")
    page.get_by_role("button", name="Start").click()
    page.wait_for_url(re.compile(r"/programs/hello-1$"))

    expect(page.locator(".words")).to_have_text(f"{RUNS} of {RUNS} made")
    expect(page.locator(".phase")).to_have_text("done")
    expect(page.locator(".facts").first).to_contain_text("bits=2")
    (file,) = striking.said.parent.glob("program_studies/hello-1/runs.jsonl")
    _, runs = kept_study(file)
    crashes = sum(run.result == "crash" for run in runs.values())
    outcomes = page.locator(".figures").first.locator("tbody tr")
    expect(outcomes).to_have_count(5)
    expect(outcomes.filter(has_text="crash").locator("td").nth(1)).to_have_text(str(crashes))

    groups = page.locator("#struck tbody tr")
    page.get_by_role("button", name="class", exact=True).click()
    expect(groups.filter(has_text="move")).to_have_count(1)
    table = page.locator(".runs tbody tr")
    expect(table).to_have_count(25)
    page.get_by_role("button", name="Next").click()
    expect(table).to_have_count(RUNS - 25)
    page.get_by_label("outcome", exact=True).click()
    page.get_by_role("option", name="crash").click()
    expect(table).to_have_count(min(crashes, 25))
    for width in WIDTHS:
        page.set_viewport_size({"width": width, "height": 900})
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), width

    table.first.get_by_role("link").click()
    page.wait_for_url(re.compile(r"/programs/hello-1/runs/\d+$"))
    number = page.url.rpartition("/")[2]
    record = runs[int(number)].injection
    expect(page.locator(".facts").nth(1)).to_contain_text(record.instruction)
    expect(page.locator(".command-line")).to_have_text(f"zenfi program replay {file} --run {number}")

    page.get_by_role("link", name="Programs").click()
    page.get_by_role("button", name="delete").click()
    page.get_by_role("dialog").get_by_role("button", name="Delete").click()
    expect(page.get_by_text("No studies yet.")).to_be_visible()
    assert not file.parent.exists()


def test_without_allowed_programs_the_page_says_what_to_do(service: Serving, looking: Looking) -> None:
    page = looking.goto(service.address, "/programs")
    expect(page.get_by_text("No program may be struck.")).to_be_visible()
    expect(page.get_by_text("zenfi serve --programs FOLDER")).to_be_visible()
    looking.expected = ("404",)
    looking.goto(service.address, "/programs/none-1")
    expect(page.get_by_text("There is no study none-1.")).to_be_visible()
