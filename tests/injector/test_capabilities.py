"""The preflight says what a machine allows, and leaves nothing behind."""

import os
from pathlib import Path

import pytest

from injector.capabilities import check

pytestmark = pytest.mark.usefixtures("may_inject")


def test_a_machine_that_can_inject_passes_every_check() -> None:
    findings = check()
    assert len(findings) == 4
    assert all(finding.ok for finding in findings)
    assert all(finding.name for finding in findings)


def test_no_process_and_no_file_is_left_behind() -> None:
    children = Path(f"/proc/self/task/{os.getpid()}/children")
    open_before, children_before = os.listdir("/proc/self/fd"), children.read_text()  # noqa: PTH208
    check()
    assert os.listdir("/proc/self/fd") == open_before  # noqa: PTH208
    assert children.read_text() == children_before
