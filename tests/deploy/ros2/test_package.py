"""The interface package: complete, and of the very types that are on the wire."""

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from deploy.ros2.package import write_package
from services.bus.messages import MESSAGES, type_hash
from services.bus.topics import TOPICS


def test_its_files_read_by_rosbags_have_the_hashes_that_we_announce(tmp_path: Path) -> None:
    package = write_package(tmp_path)
    store = get_typestore(Stores.ROS2_JAZZY)
    files = sorted((package / "msg").iterdir())
    for file in files:
        store.register(get_types_from_msg(file.read_text(), f"zenfi_msgs/msg/{file.stem}"))
    names = {f"zenfi_msgs/msg/{file.stem}" for file in files}
    assert names == {name for name in MESSAGES if name.startswith("zenfi_msgs/")}
    for topic in TOPICS.values():
        if topic.type in names:
            assert store.hash_rihs01(topic.type) == type_hash(topic.type)


def test_what_is_built_is_what_is_there(tmp_path: Path) -> None:
    package = write_package(tmp_path)
    build = (package / "CMakeLists.txt").read_text()
    listed = set(re.findall(r'"(msg/\w+\.msg)"', build))
    assert listed == {f"msg/{file.name}" for file in (package / "msg").iterdir()}
    manifest = ET.parse(package / "package.xml").getroot()  # noqa: S314 - our own
    assert manifest.findtext("name") == "zenfi_msgs"
    depends = {one.text for one in manifest.iter("depend")}
    assert depends == {"std_msgs", "geometry_msgs"}
    for one in depends:
        assert f"find_package({one} REQUIRED)" in build
    assert manifest.findtext("member_of_group") == "rosidl_interface_packages"


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    write_package(tmp_path)
    with pytest.raises(FileExistsError):
        write_package(tmp_path)
