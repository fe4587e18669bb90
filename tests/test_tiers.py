"""Every test has one tier, and a unit test starts no process."""

import subprocess
import sys

import pytest

from tests.test_names import ROOT
from tests.tiers import TIERS, UNIT, guard, tier_of


@pytest.mark.parametrize("path", UNIT)
def test_what_is_listed_as_a_unit_is_there(path: str) -> None:
    assert (ROOT / path).exists()


def test_this_test_has_one_tier(request: pytest.FixtureRequest) -> None:
    assert [mark.name for mark in request.node.iter_markers() if mark.name in TIERS] == ["unit"]


def test_a_unit_test_starts_no_process() -> None:
    with pytest.raises(RuntimeError, match=r"mark it pytest\.mark\.process"):
        subprocess.run([sys.executable, "-V"], check=True)


@pytest.mark.process
def test_another_one_may(request: pytest.FixtureRequest) -> None:
    assert tier_of(request.node) == "process"
    assert subprocess.run([sys.executable, "-V"], check=True).returncode == 0


def test_two_tiers_are_one_too_many(request: pytest.FixtureRequest) -> None:
    class Doubtful:
        nodeid = "test_x"

        @staticmethod
        def iter_markers() -> list[pytest.Mark]:
            return [pytest.mark.soak.mark, pytest.mark.unit.mark]

    with pytest.raises(pytest.UsageError, match="soak, unit"):
        tier_of(Doubtful())  # type: ignore[arg-type]
    guard(request.node)
