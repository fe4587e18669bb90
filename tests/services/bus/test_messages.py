"""Messages survive the wire, and nonsense on it is refused."""

import contextlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.bus import session
from services.bus.messages import CollisionCheck, MalformedMessageError, decode, encode, header, type_hash
from services.bus.topics import PLANNER, RECORDED, STAGES, TOPICS, published_by
from services.kernels import KERNELS

TYPE = TOPICS["collision_check"].type


def test_a_message_survives_the_wire() -> None:
    sent = CollisionCheck(
        header=header(1_500_000_000, "map"),
        trajectory_seq=3,
        future_collision_seq=2,
        collision=True,
        time_to_collision=1.25,
    )
    received = decode(encode(sent, TYPE), TYPE)
    assert (received.header.stamp.sec, received.header.stamp.nanosec) == (1, 500_000_000)
    assert (received.trajectory_seq, received.future_collision_seq) == (3, 2)
    assert received.collision
    assert received.time_to_collision == 1.25


@pytest.mark.parametrize("length", [0, 3, 4, 20, 35])
def test_truncated_bytes_are_refused(length: int) -> None:
    sent = CollisionCheck(header(0, "map"), 1, 1, collision=False, time_to_collision=np.inf)
    with pytest.raises(MalformedMessageError, match="CollisionCheck"):
        decode(encode(sent, TYPE)[:length], TYPE)


@given(st.sampled_from([topic.type for topic in RECORDED]), st.binary(max_size=400))
def test_any_bytes_are_a_message_or_refused(message_type: str, data: bytes) -> None:
    for payload in (data, b"\x00\x01\x00\x00" + data):
        with contextlib.suppress(MalformedMessageError):
            decode(payload, message_type)


@pytest.mark.parametrize("topic", ["depth", "odometry", "trajectory", "map"])
def test_a_recorded_message_is_refused_wherever_it_breaks_off(topic: str) -> None:
    kernel = {"depth": "octomap", "odometry": "octomap", "trajectory": "pid", "map": "rrt"}[topic]
    name = topic if topic in ("trajectory", "map") else f"{topic}_0"
    payload = KERNELS[kernel].sample()[name].tobytes()
    decode(payload, TOPICS[topic].type)
    for length in range(0, len(payload), 37):
        with pytest.raises(MalformedMessageError):
            decode(payload[:length], TOPICS[topic].type)


def test_keys_and_attachments_are_rmw_zenohs() -> None:
    key = session.topic_key("odometry")
    assert key == f"0/odometry/nav_msgs::msg::dds_::Odometry_/{type_hash('nav_msgs/msg/Odometry')}"
    gid = session.publisher_gid("sim", "odometry")
    attachment = session.attach(7, 40_000_000, gid)
    assert attachment == (7).to_bytes(8, "little") + (40_000_000).to_bytes(8, "little") + b"\x10" + gid


def test_the_table_of_topics_is_consistent() -> None:
    for topic in RECORDED:
        assert len(type_hash(topic.type)) == len("RIHS01_") + 64
        for kernel in topic.after:
            assert kernel == PLANNER or KERNELS[kernel].stage == topic.publisher
        if topic.trigger is not None:
            assert TOPICS[topic.trigger].rank < topic.rank
    assert {topic.name for stage in STAGES for topic in published_by(stage)} == {t.name for t in RECORDED}
