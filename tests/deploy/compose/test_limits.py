"""Processes that take more than they are granted, and limits that nobody could hold."""

import signal
import sys

import pytest

from deploy.compose.control import ControlRefusedError
from tests.conftest import PATIENCE_S, wait_until
from tests.deploy.compose.conftest import SLEEP, Laboratory, fixture


def test_who_takes_more_memory_than_granted_is_ended_with_the_reason(laboratory: Laboratory) -> None:
    limits = {"limits": {"memory_bytes": 150_000_000}, "restart": "never"}
    shares = {"command": fixture("takes_memory", "shares"), **limits}
    laboratory.up({"shares": shares})
    wait_until(lambda: laboratory.log("shares") == ["forked"] * 3, PATIENCE_S)
    takes = {"command": fixture("takes_memory", "takes"), **limits}
    laboratory.ask("declare", stack=laboratory.stack({"shares": shares, "takes": takes}))
    one = laboratory.phase("takes", "failed")
    assert one.reason.startswith("over its limit of memory: ")
    assert one.reason.endswith(" of 150 MB")
    assert (one.status, one.processes) == (-signal.SIGKILL, 0)
    other = laboratory.one("shares")
    assert (other.phase, other.processes) == ("ready", 4)
    assert other.memory_bytes > 2 * 150_000_000


def test_who_is_over_its_limit_is_started_again_by_its_policy(laboratory: Laboratory) -> None:
    limits = {"limits": {"memory_bytes": 20_000_000}, "restarts": 1}
    laboratory.up({"x": {"command": fixture("takes_memory", "shares"), **limits}})
    one = laboratory.phase("x", "failed")
    assert one.life == 2
    assert one.reason.startswith("over its limit of memory: ")
    assert "given up after 1 restarts" in one.reason


def test_nobody_opens_more_files_than_granted(laboratory: Laboratory) -> None:
    program = "import resource; print(*resource.getrlimit(resource.RLIMIT_NOFILE))"
    laboratory.up({"x": {"command": [sys.executable, "-c", program], "limits": {"open_files": 64}}})
    laboratory.phase("x", "exited")
    assert laboratory.log() == ["64 64"]


@pytest.mark.parametrize("limit", ["memory_bytes", "open_files"])
def test_a_limit_beyond_what_there_is_is_refused_before_anything_starts(
    laboratory: Laboratory, limit: str
) -> None:
    beyond = {"x": {"command": SLEEP, "limits": {limit: 2**60}}}
    told = f"processes.x.limits.{limit}: {2**60} is more than there are here"
    with pytest.raises(ControlRefusedError, match=told):
        laboratory.up(beyond)
    laboratory.up({"x": {"command": SLEEP}})
    with pytest.raises(ControlRefusedError, match=told):
        laboratory.ask("declare", stack=laboratory.stack(beyond))
    assert laboratory.phase("x", "ready").life == 1
