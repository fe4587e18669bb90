"""What this machine allows, checked by doing it: before a campaign finds out."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import tempfile
from contextlib import closing
from pathlib import Path

from deploy.forkserver import ForkServer, ForkServerError
from deploy.mission import fly
from deploy.scratch import SOCKET_PATH_LIMIT, mission_folder
from deploy.supervisor import InfrastructureError
from injector import pristine
from injector.preflight import Finding
from injector.preflight import check as injector_findings
from services.bus.mission import MissionSpec
from services.bus.session import Meeting, open_session
from sim.opengl import backend


def examine() -> list[Finding]:
    """Every check, in the order in which a mission needs them."""
    return [_python(), _processors(), _folder(), _bus(), _rgb(), *injector_findings(), _pids(), _flight()]


def _python() -> Finding:
    version = platform.python_version()
    return Finding(f"Python {version}", sys.version_info >= (3, 11), "install Python 3.11 or newer")


def _processors() -> Finding:
    count = len(os.sched_getaffinity(0))
    return Finding(f"{count} processors for {count} flights at a time", ok=True, remedy="")


def _folder() -> Finding:
    parent = Path(tempfile.gettempdir())
    remedy = f"set TMPDIR to a writable folder with a path well below {SOCKET_PATH_LIMIT} characters"
    try:
        with mission_folder():
            return Finding(f"private folders in {parent}", ok=True, remedy="")
    except (OSError, ValueError) as error:
        return Finding(f"private folders in {parent}: {error}", ok=False, remedy=remedy)


def _bus() -> Finding:
    with mission_folder() as folder:
        meeting = Meeting(folder, "zenfi/doctor")
        with open_session(meeting, "router", router=True), open_session(meeting, "node") as node:
            met = len(list(node.info.routers_zid())) == 1
    return Finding(
        "Zenoh over Unix sockets", met, "check that eclipse-zenoh is the version that pip installed"
    )


def _rgb() -> Finding:
    """Never a failure: no flight needs it."""
    found = backend()
    line = "no RGB camera: no offscreen OpenGL" if found is None else f"RGB camera with MUJOCO_GL={found}"
    return Finding(line, ok=True, remedy="")


def _pids() -> Finding:
    """Never a failure: without, some faults do not replay."""
    command = [sys.executable, "-P", "-m", "injector.own_pids"]
    found = subprocess.run(command, env=pristine.environment(os.environ), check=False)  # noqa: S603 - our own
    line = "nodes have the same pids in every flight"
    if found.returncode:
        line = (
            "nodes have other pids in each flight, so a replay can diverge where a register holds one: "
            "pid namespaces are for root with CAP_SYS_ADMIN and CAP_SYS_PTRACE, or within user namespaces"
        )
    return Finding(line, ok=True, remedy="")


def _flight() -> Finding:
    """The processes of a flight import what this one does not; the first time, they compile it."""
    remedy = (
        "standard error says why; where a module is missing or broken, install ZenFI in a new environment"
    )
    try:
        with closing(ForkServer()) as server:
            result = fly(MissionSpec(), server).outcome.result
    except (ForkServerError, InfrastructureError, OSError, ValueError) as error:
        return Finding(f"a flight in Sparse: {error}", ok=False, remedy=remedy)
    return Finding(f"a flight in Sparse: {result}", result == "success", remedy)
