"""The small campaign, flown once on this machine, to compare with."""

import pytest

from tests.dashboard.campaigns.executors.flights import Outcomes, flown_here


@pytest.fixture(scope="session")
def here() -> Outcomes:
    """What the local executor finds."""
    return flown_here()
