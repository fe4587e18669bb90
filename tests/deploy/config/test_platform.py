"""Platforms: published latencies, refusals, and what they do to a flight."""

from __future__ import annotations

from math import inf

import pytest

from deploy.bench.platform import latency
from deploy.config.check import check
from deploy.config.platform import load_platform, platform_names
from deploy.errors import BadSpecError
from deploy.mission.flight import fly
from deploy.mission.fork_server import ForkServer
from services.kernels import KERNELS
from services.models.mission import Limits, MissionSpec
from services.models.outcome import KernelUse
from services.models.platform import PlatformDefinition


def total_ms(name: str, *kernels: str) -> float:
    return sum(load_platform(name).kernels[kernel].mean_ms for kernel in kernels)


def test_the_published_latencies_add_up() -> None:
    assert total_ms("i9-9940x", "point_cloud", "octomap") == pytest.approx(289.0)
    assert total_ms("i9-9940x", "rrt_star", "trajectory") == pytest.approx(83.0)
    assert total_ms("i9-9940x", "pid") == 0.46
    assert total_ms("tx2", "point_cloud", "octomap") == pytest.approx(1870.0)
    assert total_ms("tx2", "rrt_star", "trajectory") == pytest.approx(800.0)
    assert total_ms("tx2", "collision_check") == 74.0
    assert total_ms("tx2", "pid") == 2.2


def test_every_platform_has_every_kernel() -> None:
    for name in platform_names():
        assert set(load_platform(name).kernels) == set(KERNELS)
    assert total_ms("ideal", *KERNELS) == 0.0


@pytest.mark.parametrize(
    ("change", "says"), [({"pid": None}, "no latency for pid"), ({"abacus": 1.0}, "abacus")]
)
def test_a_platform_that_does_not_match_the_kernels_is_refused(
    change: dict[str, float | None], says: str
) -> None:
    kernels = dict.fromkeys(KERNELS, 1.0) | change
    platform = PlatformDefinition.model_validate(
        {
            "name": "mine",
            "source": "",
            "kernels": {name: {"mean_ms": mean} for name, mean in kernels.items() if mean is not None},
        }
    )
    with pytest.raises(BadSpecError, match=says):
        check(MissionSpec(platform=platform))


@pytest.mark.soak
def test_a_slower_platform_flies_worse(server: ForkServer) -> None:
    """By the virtual time flown for each mission that arrives."""
    cost_s, frames = {}, {}
    for name in ("i9-9940x", "tx2"):
        flights = [fly(MissionSpec(seed=seed, platform=name), server).outcome for seed in range(5)]
        arrived = sum(flight.qof.success for flight in flights)
        flown_s = sum(flight.qof.flight_time_s for flight in flights)
        cost_s[name] = flown_s / arrived if arrived else inf
        frames[name] = sum(flight.nodes["perception"].steps for flight in flights) / flown_s
    assert cost_s["tx2"] > 1.1 * cost_s["i9-9940x"]
    assert frames["tx2"] < frames["i9-9940x"] / 3


def test_a_flight_with_jittered_latencies_repeats(server: ForkServer) -> None:
    spec = MissionSpec(seed=7, limits=Limits(mission_time_s=4.0))
    first, again = fly(spec, server), fly(spec, server)
    assert first.outcome.digest == again.outcome.digest


def test_measured_calls_become_mean_and_jitter() -> None:
    """Calls of 1, 1, 1 and 3 ms: mean 1.5 ms, deviation 0.866 ms."""
    uses = [
        KernelUse(invocations=2, cpu_ns=2_000_000, cpu_squares_ns2=2e12),
        KernelUse(invocations=2, cpu_ns=4_000_000, cpu_squares_ns2=1e12 + 9e12),
    ]
    assert latency(uses).mean_ms == pytest.approx(1.5)
    assert latency(uses).jitter == pytest.approx(0.866 / 1.5, abs=1e-3)
