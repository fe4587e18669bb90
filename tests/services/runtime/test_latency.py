from __future__ import annotations

import numpy as np
import pytest

from services.models.platform import KernelLatency
from services.runtime.latency import Latency

STATED = KernelLatency(mean_ms=20.0, jitter=0.1)


def drawn(latency: Latency, count: int) -> np.ndarray:
    return np.array([latency.of(invocation) for invocation in range(count)])


def test_draws_have_the_stated_mean_and_deviation_and_never_undercut_the_promise() -> None:
    latency = Latency(STATED, 1, "octomap", 0)
    sample = drawn(latency, 20_000)
    assert sample.mean() / 1e6 == pytest.approx(20.0, rel=0.005)
    assert sample.std() / 1e6 == pytest.approx(2.0, rel=0.05)
    assert sample.min() >= latency.least_ns == 18_000_000
    assert (sample > latency.slow_ns).mean() == pytest.approx(0.05, abs=0.01)


def test_a_draw_belongs_to_its_seed_kernel_life_and_invocation() -> None:
    sample = drawn(Latency(STATED, 1, "octomap", 0), 600)
    assert (drawn(Latency(STATED, 1, "octomap", 0), 600) == sample).all()
    late = Latency(STATED, 1, "octomap", 0)
    assert [late.of(599), late.of(3), late.of(300)] == [sample[599], sample[3], sample[300]]
    for other in (
        Latency(STATED, 2, "octomap", 0),
        Latency(STATED, 1, "pid", 0),
        Latency(STATED, 1, "octomap", 1),
    ):
        assert (drawn(other, 600) != sample).any()


def test_without_jitter_every_call_takes_the_mean() -> None:
    latency = Latency(KernelLatency(mean_ms=0.46), 1, "pid", 0)
    assert set(drawn(latency, 10)) == {460_000}
    assert latency.least_ns == latency.slow_ns == 460_000
