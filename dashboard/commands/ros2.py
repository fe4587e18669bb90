"""``zenfi ros2``: our messages for ROS 2, and ROS 2 nodes in the place of stages."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import click

from deploy.errors import BadSpecError
from deploy.mission.flight import Watch
from deploy.recording.recorder import FlightRecorder
from deploy.ros2.bridge import Bridge
from deploy.ros2.domain import ROUTER, Domain, DomainAddress
from deploy.ros2.package import write_package
from deploy.ros2.stage import NobodyError, Relay
from services.models.mission import MissionSpec


class RosOptions(NamedTuple):
    """Where a flight is shown, and how many times as fast as real time."""

    meeting: DomainAddress
    pace: float


def shown_in_ros(command: Callable[..., None]) -> Callable[..., None]:
    """The options by which a flight is shown in a ROS 2 domain, as one argument ``ros``."""

    @click.option("--ros-domain", type=int, metavar="N", help="Show the flight in this ROS 2 domain.")
    @click.option("--ros-endpoint", default=ROUTER, show_default=True, help="Where its Zenoh router listens.")
    @click.option(
        "--ros-pace",
        type=click.FloatRange(0, 1000),
        default=1.0,
        show_default=True,
        help="So many times as fast as real time; 0: as fast as it is flown.",
    )
    @functools.wraps(command)
    def with_ros(
        *arguments: Any, ros_domain: int | None, ros_endpoint: str, ros_pace: float, **more: Any
    ) -> None:
        meeting = None if ros_domain is None else DomainAddress(domain=ros_domain, endpoint=ros_endpoint)
        command(*arguments, ros=None if meeting is None else RosOptions(meeting, ros_pace), **more)

    return with_ros


@contextmanager
def in_domain(ros: RosOptions | None, spec: MissionSpec) -> Iterator[Watch | None]:
    """What shows the flight of ``spec`` (not its twin) in a domain; at the end, waits until it is shown."""
    if ros is None:
        yield None
        return
    with Domain(ros.meeting) as domain:
        bridge = Bridge(domain, ros.pace)

        def watch(flown: MissionSpec, recorder: FlightRecorder) -> None:
            if (flown.fault is None) == (spec.fault is None):
                bridge.show(flown, recorder)

        yield watch
        bridge.finish()


@click.group()
def ros2() -> None:
    """ROS 2 over Zenoh (rmw_zenoh); see docs/ros2.md."""


@ros2.command()
@click.argument("folder", type=click.Path(file_okay=False, path_type=Path))
def package(folder: Path) -> None:
    """Write the interface package zenfi_msgs into FOLDER, e.g. the src of a workspace."""
    try:
        click.echo(write_package(folder))
    except OSError as error:
        message = f"{error.filename}: {error.strerror}"
        raise BadSpecError(message) from error


@ros2.command()
@click.option("--domain", type=int, default=0, show_default=True, help="ROS_DOMAIN_ID of the node.")
@click.option("--endpoint", default=ROUTER, show_default=True, help="Where its Zenoh router listens.")
@click.option("--await", "awaited", multiple=True, metavar="TOPIC", help="Answered in every step.")
@click.option("--patience-s", default=20.0, show_default=True, help="Wall time for the node to appear.")
def stage(domain: int, endpoint: str, awaited: tuple[str, ...], patience_s: float) -> None:
    """Let a ROS 2 node take a stage's place: the command of a stage in a stack file."""
    try:
        with Domain(DomainAddress(domain=domain, endpoint=endpoint)) as joined:
            Relay(joined, awaited, patience_s).serve(sys.stdin.buffer, sys.stdout.buffer)
    except (BadSpecError, NobodyError) as error:
        click.echo(str(error))  # in the place of an answer: whoever awaits one tells it
