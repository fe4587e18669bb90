"""Our messages as a ROS 2 interface package, made from the one place where they are defined."""

from __future__ import annotations

from importlib.metadata import metadata
from pathlib import Path

from services.bus.messages import MESSAGES, definition

NAME = "zenfi_msgs"

_MANIFEST = """<?xml version="1.0"?>
<package format="3">
  <name>{name}</name>
  <version>{version}</version>
  <description>Messages of ZenFI, fault injection for autonomous machines</description>
  <maintainer email="zenfi@example.org">ZenFI</maintainer>
  <license>Apache-2.0</license>

  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
{depends}
  <exec_depend>rosidl_default_runtime</exec_depend>
  <member_of_group>rosidl_interface_packages</member_of_group>

  <export>
    <build_type>ament_cmake</build_type>
  </export>
</package>
"""

_BUILD = """cmake_minimum_required(VERSION 3.8)
project({name})

find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
{find}

rosidl_generate_interfaces(${{PROJECT_NAME}}
{files}
  DEPENDENCIES {packages}
)

ament_export_dependencies(rosidl_default_runtime)
ament_package()
"""


def interface_package() -> dict[str, str]:
    """The files of the package: text by path."""
    ours = {name.rpartition("/")[2]: definition(name) for name in MESSAGES if name.startswith(f"{NAME}/")}
    used = {line.split("/")[0] for text in ours.values() for line in text.splitlines() if "/" in line}
    packages = sorted(used - {NAME})
    files = [f"msg/{short}.msg" for short in sorted(ours)]
    return {
        "package.xml": _MANIFEST.format(
            name=NAME,
            version=metadata("zenfi")["Version"],
            depends="\n".join(f"  <depend>{one}</depend>" for one in packages),
        ),
        "CMakeLists.txt": _BUILD.format(
            name=NAME,
            find="\n".join(f"find_package({one} REQUIRED)" for one in packages),
            files="\n".join(f'  "{file}"' for file in files),
            packages=" ".join(packages),
        ),
        **{f"msg/{short}.msg": text + "\n" for short, text in sorted(ours.items())},
    }


def write_package(folder: Path) -> Path:
    """Write the package into a folder of its name in ``folder``; that folder.

    :raises FileExistsError: if there is one.
    """
    package = folder / NAME
    package.mkdir(parents=True)
    for path, text in interface_package().items():
        file = package / path
        file.parent.mkdir(exist_ok=True)
        file.write_text(text)
    return package
