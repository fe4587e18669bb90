"""rmw_zenoh's scheme byte by byte: as its design document has it, and as another implementation has it."""

import struct

import pytest
import zenoh.ext
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from zenoh_ros2_sdk.attachment import Attachment as TheirAttachment
from zenoh_ros2_sdk.entity import EndpointEntity, EntityKind, NodeEntity
from zenoh_ros2_sdk.keyexpr import endpoint_liveliness_keyexpr, node_liveliness_keyexpr, topic_keyexpr
from zenoh_ros2_sdk.qos import QosDurability, QosProfile, QosReliability
from zenoh_ros2_sdk.utils import get_type_hash, ros2_to_dds_type

from services.bus.messages import MESSAGES, TYPESTORE, definition, type_hash
from services.bus.ros2 import Attachment, Qos, RosNode, data_key, dds_type
from services.bus.session import topic_key
from services.bus.topics import TOPICS

STRING = "std_msgs/msg/String"
STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
TYPES = sorted({topic.type for topic in TOPICS.values()} | set(MESSAGES) | {STRING})

# -- examples of the design document -----------------------------------------------------------------


def test_data_keys_of_the_design_document() -> None:
    assert data_key(0, "chatter", STRING) == f"0/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"
    robot = f"0/robot1/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"
    assert data_key(0, "/robot1/chatter", STRING) == robot


def test_tokens_of_the_design_document() -> None:
    listener = RosNode(2, "aac3178e146ba6f1fc6e6a4085e77f21", 0, "listener")
    assert listener.token == "/".join(["@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%", "listener"])
    assert listener.endpoint_token(10, "MS", "/chatter", STRING, Qos(depth=10)) == (
        "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MS/%/%/listener/%chatter/"
        f"std_msgs::msg::dds_::String_/{STRING_HASH}/::,10:,:,:,,"
    )
    talker = RosNode(2, "8b20917502ee955ac4476e0266340d5c", 0, "talker")
    assert talker.endpoint_token(10, "MP", "/chatter", STRING, Qos(depth=7)) == (
        "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/"
        f"std_msgs::msg::dds_::String_/{STRING_HASH}/::,7:,:,:,,"
    )


def test_the_attachment_of_the_design_document() -> None:
    gid = bytes(range(16))
    packed = Attachment(1, 1_700_000_000_000_000_000, gid).packed()
    as_documented = struct.pack("<q", 1) + struct.pack("<q", 1_700_000_000_000_000_000) + b"\x10" + gid
    assert packed == as_documented
    # Zenoh's own serializer, which rmw_zenoh uses, makes the same of the three.
    parts = (zenoh.ext.Int64(1), zenoh.ext.Int64(1_700_000_000_000_000_000), gid)
    assert packed == b"".join(zenoh.ext.z_serialize(part).to_bytes() for part in parts)
    assert Attachment.unpacked(packed) == (1, 1_700_000_000_000_000_000, gid)
    assert Attachment.split(packed + b"more") == (Attachment.unpacked(packed), b"more")


@pytest.mark.parametrize("raw", [b"", bytes(16), bytes(34)])
def test_an_attachment_of_another_form_is_refused(raw: bytes) -> None:
    with pytest.raises(ValueError, match="attachment of"):
        Attachment.unpacked(raw)


# -- another implementation --------------------------------------------------------------------------


def nested(name: str) -> dict[str, str]:
    """The definitions of all that a type is made of."""
    found: dict[str, str] = {}
    waiting = [name]
    while waiting:
        for line in definition(waiting.pop()).splitlines():
            of = line.split("[")[0].split()[0].replace("/", "/msg/")
            if "/" in of and of not in found:
                found[of] = definition(of)
                waiting.append(of)
    return found


@pytest.mark.parametrize("name", TYPES)
def test_type_hashes_agree(name: str) -> None:
    assert get_type_hash(name, definition(name), nested(name)) == type_hash(name)


@pytest.mark.parametrize("name", TYPES)
def test_a_definition_read_again_is_the_same_type(name: str) -> None:
    store = get_typestore(Stores.EMPTY)
    for one, text in {**nested(name), name: definition(name)}.items():
        store.register(get_types_from_msg(text, one))
    assert store.hash_rihs01(name) == TYPESTORE.hash_rihs01(name)


@pytest.mark.parametrize("name", TOPICS)
def test_keys_agree(name: str) -> None:
    message_type = TOPICS[name].type
    theirs = topic_keyexpr(0, f"/{name}", ros2_to_dds_type(message_type), type_hash(message_type))
    assert theirs == topic_key(name) == data_key(0, name, message_type)


@pytest.mark.parametrize("reliable", [True, False])
@pytest.mark.parametrize("transient_local", [True, False])
@pytest.mark.parametrize("kind", ["MP", "MS"])
def test_tokens_agree(reliable: bool, transient_local: bool, kind: str) -> None:
    ours = RosNode(7, "c0ffee", 3, "planning", "/drone")
    node = NodeEntity(7, "c0ffee", 3, "planning", "/drone")
    assert ours.token == node_liveliness_keyexpr(node)
    qos = QosProfile(
        reliability=QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT,
        durability=QosDurability.TRANSIENT_LOCAL if transient_local else QosDurability.VOLATILE,
        history_depth=5,
    )
    name = "zenfi_msgs/msg/Trajectory"
    endpoint = EndpointEntity(
        node, 12, EntityKind(kind), "/drone/trajectory", dds_type(name), type_hash(name), qos.encode()
    )
    mine = ours.endpoint_token(12, kind, "/drone/trajectory", name, Qos(reliable, transient_local, 5))  # type: ignore[arg-type]
    assert mine == endpoint_liveliness_keyexpr(endpoint)


def test_attachments_agree() -> None:
    gid = bytes(range(100, 116))
    assert Attachment(5, 40_000_000, gid).packed() == TheirAttachment(5, 40_000_000, gid).to_bytes()
    theirs = TheirAttachment.from_bytes(Attachment(5, 40_000_000, gid).packed())
    assert (theirs.sequence_id, theirs.timestamp_ns, theirs.gid) == (5, 40_000_000, gid)
