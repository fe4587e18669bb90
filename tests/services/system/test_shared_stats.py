"""The page that a node and its supervisor share."""

from contextlib import closing

import pytest

from services.system.shared_stats import STEPS_KEPT, SharedStats


@pytest.mark.parametrize("ahead", range(STEPS_KEPT))
def test_steps_after_the_end_of_a_flight_do_not_count(ahead: int) -> None:
    with closing(SharedStats.create("node")) as stats:
        for step in range(10 + ahead):
            stats.begin_step(step * 100)
            stats.page["guards"][2] += 1
            stats.page["dropped"] += 3
            stats.page["steps"] += 1
        ended = stats.counts(10 * 100)
        assert (ended["steps"], ended["dropped"], ended["guards"][2]) == (10, 30, 10)
        assert stats.counts(10**9)["steps"] == 10 + ahead


def test_of_two_steps_at_one_instant_the_first_is_after_the_end() -> None:
    with closing(SharedStats.create("node")) as stats:
        for step in range(3, 3 + STEPS_KEPT):  # the later ones lie first on the page
            stats.page["steps"] = step
            stats.begin_step(1000)
        assert stats.counts(1000)["steps"] == 3


def test_a_node_that_makes_no_steps_reports_what_it_counted() -> None:
    with closing(SharedStats.create("node")) as stats:
        stats.page["malformed"] = 2
        assert stats.counts(1000)["malformed"] == 2


def test_a_page_of_another_host_reads_as_that_one() -> None:
    with closing(SharedStats.create("there")) as there, closing(SharedStats.create("here")) as here:
        there.page["malformed"] = 2
        here.replace(there.content())
        there.page["malformed"] = 3
        assert here.counts(1000)["malformed"] == 2
        with pytest.raises(ValueError, match="a page has"):
            here.replace(there.content()[1:])
