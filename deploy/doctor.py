"""Checks by trial whether this machine allows what missions and campaigns need."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import tempfile
from contextlib import closing
from pathlib import Path

from deploy.config.workdir import SOCKET_PATH_LIMIT, mission_folder
from deploy.errors import InfrastructureError
from deploy.mission.flight import fly
from deploy.mission.fork_server import ForkServer, ForkServerError
from injector.capabilities import Capability
from injector.capabilities import check as injector_findings
from injector.reproducible import launch
from services.bus.session import BusAddress, open_session
from services.models.mission import MissionSpec
from sim.sensors.opengl import backend


def examine() -> list[Capability]:
    """Every check, in the order in which a mission needs them."""
    return [_python(), _processors(), _folder(), _bus(), _rgb(), *injector_findings(), _pids(), _flight()]


def _python() -> Capability:
    version = platform.python_version()
    return Capability(f"Python {version}", sys.version_info >= (3, 11), "install Python 3.11 or newer")


def _processors() -> Capability:
    count = len(os.sched_getaffinity(0))
    return Capability(f"{count} processors for {count} flights at a time", ok=True, remedy="")


def _folder() -> Capability:
    parent = Path(tempfile.gettempdir())
    remedy = f"set TMPDIR to a writable folder with a path well below {SOCKET_PATH_LIMIT} characters"
    try:
        with mission_folder():
            return Capability(f"private folders in {parent}", ok=True, remedy="")
    except (OSError, ValueError) as error:
        return Capability(f"private folders in {parent}: {error}", ok=False, remedy=remedy)


def _bus() -> Capability:
    with mission_folder() as folder:
        address = BusAddress(folder, "zenfi/doctor")
        with open_session(address, "router", router=True), open_session(address, "node") as node:
            met = len(list(node.info.routers_zid())) == 1
    return Capability(
        "Zenoh over Unix sockets", met, "check that eclipse-zenoh is the version that pip installed"
    )


def _rgb() -> Capability:
    """Check the RGB camera; never a failure, since no flight needs it."""
    found = backend()
    line = "no RGB camera: no offscreen OpenGL" if found is None else f"RGB camera with MUJOCO_GL={found}"
    return Capability(line, ok=True, remedy="")


def _pids() -> Capability:
    """Check pid namespaces; never a failure, but without them some faults do not replay."""
    command = [sys.executable, "-P", "-m", "injector.reproducible.pid_namespace"]
    found = subprocess.run(command, env=launch.environment(os.environ, compiled="doctor"), check=False)  # noqa: S603 - our own
    line = "nodes have the same pids in every flight"
    if found.returncode:
        line = (
            "nodes have other pids in each flight, so a replay can diverge where a register holds one: "
            "pid namespaces are for root with CAP_SYS_ADMIN and CAP_SYS_PTRACE, or within user namespaces"
        )
    return Capability(line, ok=True, remedy="")


def _flight() -> Capability:
    """Check a flight: its processes import what this one does not; the first time, they compile it."""
    remedy = (
        "standard error says why; where a module is missing or broken, install ZenFI in a new environment"
    )
    try:
        with closing(ForkServer()) as server:
            result = fly(MissionSpec(), server).outcome.result
    except (ForkServerError, InfrastructureError, OSError, ValueError) as error:
        return Capability(f"a flight in Sparse: {error}", ok=False, remedy=remedy)
    return Capability(f"a flight in Sparse: {result}", result == "success", remedy)
