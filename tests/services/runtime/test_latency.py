from __future__ import annotations

import numpy as np
import pytest

from services.bus.topics import OVER_LINK, RECORDED, TICK_NS
from services.models.equipment import Link
from services.models.platform import KernelLatency
from services.runtime.latency import Latency, VirtualLink

STATED = KernelLatency(mean_ms=20.0, jitter=0.1)
TICKS = range(0, 4000 * TICK_NS, TICK_NS)


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


def lost(link: VirtualLink, topic: str, offset_ns: int = 0) -> set[int]:
    """The ticks whose message is lost; sets, as pytest takes minutes to show how long lists differ."""
    return {at for at in TICKS if link.arrival_ns(topic, at + offset_ns) is None}


def test_what_goes_over_the_link_comes_later_and_nothing_else_does() -> None:
    link = VirtualLink(Link(delay_ms=12.5), 3)
    for topic in RECORDED:
        late_ns = 12_500_000 if topic.name in OVER_LINK else 0
        assert link.arrival_ns(topic.name, TICK_NS) == TICK_NS + late_ns
        assert link.least_ns(topic.name) == late_ns


def test_the_share_that_is_lost_is_the_one_asked_for() -> None:
    for topic in sorted(OVER_LINK):
        share = len(lost(VirtualLink(Link(loss=0.1), 5), topic)) / len(TICKS)
        assert share == pytest.approx(0.1, abs=0.02)  # 4 standard errors


def test_losses_differ_by_topic_and_seed_and_not_within_a_tick() -> None:
    of_seed = VirtualLink(Link(loss=0.5), 5)
    assert lost(of_seed, "depth") == lost(VirtualLink(Link(loss=0.5), 5), "depth")
    assert lost(of_seed, "command") == lost(of_seed, "command", offset_ns=TICK_NS - 1)
    assert lost(of_seed, "depth") != lost(of_seed, "odometry")
    assert lost(of_seed, "depth") != lost(VirtualLink(Link(loss=0.5), 6), "depth")


def test_a_link_that_does_nothing_is_ideal() -> None:
    assert Link().is_ideal
    assert not Link(delay_ms=1).is_ideal
    assert not Link(loss=0.01).is_ideal
