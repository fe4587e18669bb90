"""Whether the mission's fault may strike a node's next kernel calls."""

import socket
from collections.abc import Iterator

import pytest

from services.bus.proxy_link import NodeLink
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec
from services.runtime.kernel_timer import MOST_CALLS, KernelTimer
from services.runtime.setup import NodeSetup
from services.system.shared_stats import SharedStats

KERNELS = ["rrt_star", "pid"]

RECURRING = {"recurrence": "permanent", "opcodes": ("mulsd",), "until_s": 3.0}


@pytest.fixture
def stats() -> SharedStats:
    return SharedStats.create("test")


@pytest.fixture
def link() -> Iterator[NodeLink]:
    proxy, node = socket.socketpair()
    with proxy, node:
        yield NodeLink(node)


def timer(stats: SharedStats, link: NodeLink, fault: dict[str, object] | None) -> KernelTimer:
    spec = MissionSpec(fault=FaultSpec.model_validate(fault) if fault is not None else None)
    setup = NodeSetup(name="control", spec=spec, kernels=KERNELS, latencies={}, expected=[])
    return KernelTimer(setup, link, stats.page)


def test_a_fault_may_strike_the_calls_just_before_the_armed_one_and_none_behind_it(
    stats: SharedStats, link: NodeLink
) -> None:
    stats.arm(20, None)
    asked = timer(stats, link, {"target": "pid"})
    found = []
    for calls in range(40):
        stats.page["invocations"][:2] = 99, calls
        found += [calls] * asked.may_be_struck(0)
    assert found == list(range(21 - MOST_CALLS, 21))


def test_one_that_waits_for_a_time_may_strike_any(stats: SharedStats, link: NodeLink) -> None:
    stats.arm(None, 5)
    assert timer(stats, link, {"target": "pid"}).may_be_struck(0)


@pytest.mark.parametrize(("now_ns", "may"), [(0, True), (2_999_999_999, True), (3_000_000_000, False)])
def test_one_that_recurs_may_strike_until_its_end(
    now_ns: int, may: bool, stats: SharedStats, link: NodeLink
) -> None:
    assert timer(stats, link, {"target": "pid", **RECURRING}).may_be_struck(now_ns) == may


@pytest.mark.parametrize(
    "fault",
    [
        None,
        {"target": "octomap"},
        {"target": "octomap", **RECURRING},
        {"level": "source", "target": "command.vx"},
        {"level": "sensor", "target": "odometry", "model": "off"},
    ],
)
def test_what_strikes_no_kernel_of_the_node_may_not(
    fault: dict[str, object] | None, stats: SharedStats, link: NodeLink
) -> None:
    stats.arm(0, 0)
    assert not timer(stats, link, fault).may_be_struck(0)
