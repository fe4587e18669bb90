"""What a test of the injector needs of the machine."""

import pytest

from injector.capabilities import check


@pytest.fixture(scope="session")
def may_inject() -> None:
    """Fail, saying what to do, where the kernel forbids tracing or timing: nothing here can be shown then."""
    for finding in check():
        if not finding.ok:
            pytest.fail(f"{finding.name}: {finding.remedy}")
