"""What a test of the injector needs of the machine."""

import pytest

from injector.preflight import check


@pytest.fixture(autouse=True, scope="session")
def _may_inject() -> None:
    """Skip, saying what to do, where the kernel forbids tracing or timing."""
    for finding in check():
        if not finding.ok:
            pytest.skip(f"{finding.name}: {finding.remedy}")
