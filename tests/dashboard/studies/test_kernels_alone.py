"""The paper's statements on kernels alone hold only beyond the intervals."""

import pytest

from dashboard.studies.kernels_alone import KernelsAlone, Statement, counts_of, statements
from dashboard.studies.verdict import Verdict
from tests.dashboard.commands.test_kernels import run


def kernel(benign: int, sdc: int, crash: int = 0) -> dict[str, int]:
    return {"benign": benign, "sdc": sdc, "crash": crash, "hang": 0}


AS_PUBLISHED = {
    "octomap": kernel(1000, 2000, 2000),
    "rrt": kernel(2000, 400, 2600),
    "rrt_connect": kernel(2000, 300, 2700),
    "rrt_star": kernel(2000, 100, 2900),
    "pid": kernel(2000, 500, 2500),
}


def told(found: dict[str, dict[str, int]]) -> dict[str, Statement]:
    return {one.what: one for one in statements(found)}


def test_outcomes_as_the_paper_has_them_confirm_all_it_says() -> None:
    found = told(AS_PUBLISHED)
    assert {one.verdict for one in found.values()} == {"confirmed"}
    assert found["most silent corruption (SDC)"].ours == "octomap: 40.0 % (38.7 to 41.4)"
    assert found["least silent corruption of the planners"].ours.startswith("rrt_star: 2.0 %")
    assert found["benign in octomap"].paper == "less than 25 %"


@pytest.mark.parametrize(
    ("changed", "counts", "what", "verdict"),
    [
        ("pid", kernel(1700, 3000, 300), "most silent corruption (SDC)", "not confirmed"),
        ("pid", kernel(2000, 2010, 990), "most silent corruption (SDC)", "not resolved"),
        ("octomap", kernel(2500, 2500), "benign in octomap", "not confirmed"),
        ("octomap", kernel(1245, 3755), "benign in octomap", "not resolved"),
        ("pid", kernel(1000, 500, 3500), "benign in the others, the smallest", "not confirmed"),
        ("pid", kernel(1260, 500, 3240), "benign in the others, the smallest", "not resolved"),
        ("rrt", kernel(2000, 20, 2980), "least silent corruption of the planners", "not confirmed"),
        ("rrt", kernel(2000, 110, 2890), "least silent corruption of the planners", "not resolved"),
    ],
)
def test_the_opposite_is_not_confirmed_and_what_intervals_leave_open_is_not_resolved(
    changed: str, counts: dict[str, int], what: str, verdict: Verdict
) -> None:
    found = told({**AS_PUBLISHED, changed: counts})
    assert found[what].verdict == verdict
    assert [one.verdict for one in found.values() if one.what != what] == ["confirmed"] * 3


def test_a_few_injections_resolve_nothing_and_none_claim_nothing() -> None:
    few = {name: {result: n // 500 for result, n in counts.items()} for name, counts in AS_PUBLISHED.items()}
    assert {one.verdict for one in statements(few)} == {"not resolved"}
    assert {one.verdict for one in statements({})} == {"not flown"}
    alone = told({"pid": kernel(1, 0)})
    assert alone["benign in octomap"].verdict == "not flown"
    assert alone["most silent corruption (SDC)"].verdict == "not flown"


def test_only_the_injected_count() -> None:
    runs = [run(0, "benign", "rax"), run(1, "sdc", "rax"), run(2, "not_injected", "rax")]
    assert sum(counts_of({"pid": runs})["pid"].values()) == 2


def test_a_scale_never_leaves_a_kernel_without_an_injection() -> None:
    assert KernelsAlone().scaled(10).injections == 50_000
    assert KernelsAlone().scaled(1e-9).injections == 1
