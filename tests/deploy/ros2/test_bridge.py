"""A flight in a ROS 2 domain: heard by nodes of another implementation, found in the graph, and the same."""

import queue
from collections.abc import Iterator
from typing import Any

import pytest
import xxhash
import zenoh
import zenoh.ext

from deploy.errors import BadSpecError
from deploy.mission.flight import FlownMission, fly
from deploy.mission.fork_server import ForkServer
from deploy.ros2.bridge import Bridge
from deploy.ros2.domain import Domain, DomainAddress, NoRouterError, Publisher
from services.bus.messages import decode, definition
from services.bus.ros2 import Attachment, Qos
from services.bus.topics import RECORDED, TOPICS
from services.models.mission import Limits, MissionSpec
from tests.conftest import wait_until
from tests.fixtures import ros_nodes

SPEC = MissionSpec(world="sparse", seed=7, limits=Limits(mission_time_s=3.0))
DOMAIN, OTHER = 7, 9


@pytest.fixture(scope="module")
def plain(server: ForkServer) -> FlownMission:
    return fly(SPEC, server, keep_messages=True)


@pytest.fixture
def visitor(endpoint: str) -> Iterator[zenoh.Session]:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    config.insert_json5("timestamping/enabled", "true")
    with zenoh.open(config) as session:
        yield session


class LinkedDomain(Domain):
    """A domain that knows who receives what is published in it."""

    def __init__(self, address: DomainAddress) -> None:
        super().__init__(address)
        self._publishers: dict[str, Publisher] = {}

    def publisher(self, node: str, topic: str, message_type: str, qos: Qos) -> Publisher:
        self._publishers[topic] = super().publisher(node, topic, message_type, qos)
        return self._publishers[topic]

    def are_linked(self, topics: tuple[str, ...]) -> bool:
        return all(self._publishers[topic].is_linked for topic in topics)


def fly_shown(domain: LinkedDomain, server: ForkServer, *topics: str) -> FlownMission:
    """A flight that is shown as soon as somebody receives those topics."""
    bridge = Bridge(domain, 0.0)
    wait_until(lambda: domain.are_linked(topics))
    flight = fly(SPEC, server, watch=bridge.show)
    bridge.finish()
    return flight


def test_another_implementation_hears_the_flight(
    port: int, endpoint: str, server: ForkServer, plain: FlownMission
) -> None:
    texts = {"zenfi_msgs/msg/Goal": definition("zenfi_msgs/msg/Goal")}
    twist = ros_nodes.described("geometry_msgs/msg/TwistStamped", {})
    goal = ros_nodes.described("zenfi_msgs/msg/Goal", texts)
    heard = ros_nodes.subscriber(port, DOMAIN, "/command", twist)
    goals = ros_nodes.subscriber(port, DOMAIN, "/goal", goal)
    elsewhere = ros_nodes.subscriber(port, DOMAIN + 1, "/command", twist)
    clock = ros_nodes.subscriber(port, DOMAIN, "/clock", ros_nodes.described("rosgraph_msgs/msg/Clock", {}))
    moved = ros_nodes.subscriber(port, DOMAIN, "/tf", ros_nodes.described("tf2_msgs/msg/TFMessage", {}))
    with LinkedDomain(DomainAddress(domain=DOMAIN, endpoint=endpoint)) as domain:
        flight = fly_shown(domain, server, "/command", "/goal", "/clock", "/tf")
        assert flight.outcome.digest == plain.outcome.digest
        assert plain.messages is not None
        sent = [decode(one.payload, TOPICS["command"].type) for one in plain.messages["command"]]
        wait_until(lambda: heard.qsize() >= len(sent))
        wait_until(lambda: clock.qsize() >= 70)
        wait_until(lambda: moved.qsize() >= 70)
    got = [heard.get() for _ in sent]
    assert [one.twist.linear.x for one in got] == [one.twist.linear.x for one in sent]
    assert [one.header.stamp.nanosec for one in got] == [one.header.stamp.nanosec for one in sent]
    assert goals.get(timeout=5).position.x == 25.0
    (transform,) = moved.get().transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("odom", "base_link")
    assert elsewhere.empty()


def test_every_topic_is_in_the_graph_and_stamped_by_its_publisher(
    endpoint: str, visitor: zenoh.Session, server: ForkServer
) -> None:
    came: queue.SimpleQueue[Any] = queue.SimpleQueue()
    subscription = visitor.declare_subscriber(f"{OTHER}/odometry/**", came.put)
    with LinkedDomain(DomainAddress(domain=OTHER, endpoint=endpoint)) as domain:
        fly_shown(domain, server, "/odometry")
        wait_until(lambda: came.qsize() >= 70)
        found = visitor.liveliness().get(f"@ros2_lv/{OTHER}/**", timeout=5.0)
        tokens = [str(reply.ok.key_expr) for reply in found if reply.ok is not None]
        latched = zenoh.ext.declare_advanced_subscriber(
            visitor,
            f"{OTHER}/map/**",
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
        )
        late = latched.recv()
    chunks = [token.split("/") for token in tokens]
    assert {one[8] for one in chunks if one[5] == "NN"} == {
        "sim",
        "perception",
        "planning",
        "control",
        "derived",
    }
    published = {(one[8], one[9].replace("%", "/")): "/".join(one) for one in chunks if one[5] == "MP"}
    for topic in RECORDED:
        assert (topic.publisher, f"/{topic.name}") in published
    # Quality of service as tf2 has it: reliable; the last 100, and for later subscribers the last one.
    assert published["derived", "/tf"].endswith("/::,100:,:,:,,")
    assert published["derived", "/tf_static"].endswith("/:1:,1:,:,:,,")
    assert len({one[4] for one in chunks}) == len(chunks), "an endpoint's number is its own"
    attachments = [Attachment.unpacked(came.get().attachment.to_bytes()) for _ in range(70)]
    assert [one.seq for one in attachments] == list(range(1, 71))
    assert [one.source_ns for one in attachments] == [40_000_000 * tick for tick in range(70)]
    token = published["sim", "/odometry"]
    assert {one.gid for one in attachments} == {xxhash.xxh3_128_digest(token.encode())[::-1]}
    assert decode(late.payload.to_bytes(), TOPICS["map"].type).id == "OcTree"
    subscription.undeclare()  # type: ignore[no-untyped-call]


def test_the_identity_is_that_of_the_published_algorithm() -> None:
    """XXH3-128 of nothing, as its specification has it; rmw_zenoh has the low half first."""
    from deploy.ros2.domain import gid

    assert gid("").hex() == bytes.fromhex("99aa06d3014798d86001c324468d497f")[::-1].hex()


def test_without_a_router_it_says_what_to_start() -> None:
    with pytest.raises(NoRouterError, match="no Zenoh router at tcp/127"):
        Domain(DomainAddress(domain=0, endpoint="tcp/127.0.0.1:1"))


@pytest.mark.parametrize("endpoint", ["tcp/192.0.2.1:7447", "udp/127.0.0.1:7447", "nonsense"])
def test_an_endpoint_beyond_this_machine_is_refused_unless_it_is_tls(endpoint: str) -> None:
    with pytest.raises(BadSpecError, match=r"endpoint|beyond this machine"):
        Domain(DomainAddress(domain=0, endpoint=endpoint))
