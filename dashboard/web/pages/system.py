"""What runs on this machine: nodes on the buses, processes, stacks; versions, and what the machine allows."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version

from nicegui import ui

from dashboard.api.routes.nodes import NodeInfo, ProcessInfo, list_nodes, list_processes
from dashboard.api.service import Service
from dashboard.web.components.frame import REFUSED, ask, frame, nothing, section, trouble
from dashboard.web.components.parts import facts, log, table
from deploy.compose.control import StackView
from deploy.compose.logs import tail
from deploy.doctor import examine

LOOK_S = 3.0
LOG_LINES = 20

_STATES = {"R": "runs", "S": "waits", "D": "waits for a disk", "T": "stopped", "t": "traced", "Z": "ended"}

PACKAGES = ("zenfi", "eclipse-zenoh", "mujoco", "ompl", "pyoctomap", "numba", "numpy", "rosbags", "nicegui")


class ProcessorShare:
    """Processor time as a part of one processor, between two looks."""

    def __init__(self) -> None:
        self._before: dict[int, tuple[float, float]] = {}

    def of(self, pid: int, cpu_s: float, now_s: float) -> str:
        """What a process used since the last look, a dash at the first."""
        before = self._before.get(pid)
        self._before[pid] = cpu_s, now_s
        if before is None or now_s <= before[1] or cpu_s < before[0]:
            return "-"
        return f"{100 * (cpu_s - before[0]) / (now_s - before[1]):.0f} %"


def register(service: Service) -> None:
    """Declare the page of processes and nodes."""

    @ui.page("/system", response_timeout=60)
    async def page() -> None:
        with frame("System"):
            with section("Nodes", "On the buses of the flights that the service flies now."):
                nodes = ui.column().classes("section")
            with section("Processes of the service"):
                processes = ui.column().classes("section")
            with section("Stacks", "What zenfi up keeps running."):
                stacks = ui.column().classes("section")
            with section("Versions"):
                facts(await ask(versions))
            with section("What this machine allows", "As zenfi doctor says."):
                place = ui.column().classes("section")
                ui.button("Check", icon="fact_check", on_click=lambda: _check(place)).props("no-caps")
        shares = ProcessorShare(), ProcessorShare()

        async def look() -> None:
            try:
                told, found = await ask(list_processes, service), await ask(list_nodes, service)
            except REFUSED as error:
                nodes.clear()
                with nodes:
                    trouble(str(error), "It is asked again in a moment.")
                return
            now_s = time.monotonic()
            _redraw(nodes, found, lambda: _nodes(found, shares[0], now_s))
            _redraw(processes, told.service, lambda: _processes(told.service, shares[1], now_s))
            _redraw(stacks, told.stacks, lambda: _stacks(told.stacks))

        await look()
        ui.timer(LOOK_S, look, immediate=False)


def _redraw(place: ui.column, found: Sequence[object], draw: Callable[[], None]) -> None:
    place.clear()
    with place:
        draw()
    place.props["data-count"] = len(found)


def versions() -> dict[str, str]:
    """Of the packages that a flight depends on, and of what they run on."""
    found = {"Python": platform.python_version(), "System": f"{platform.system()} {platform.release()}"}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed as a package"
    return found


async def _check(place: ui.column) -> None:
    place.clear()
    with place:
        waiting = ui.label("checking").classes("note").props('role="status"')
    findings = await ask(examine)
    waiting.delete()
    with place:
        rows = [
            ("in order" if one.ok else "amiss", one.name, "" if one.ok else one.remedy) for one in findings
        ]
        table("What this machine allows", ("", "check", "remedy"), rows)


def _megabytes(size: int) -> str:
    return f"{size / 1e6:.0f} MB"


def _nodes(found: Sequence[NodeInfo], share: ProcessorShare, now_s: float) -> None:
    if not found:
        nothing("No node is on a bus.", "Nodes are here while something flies: see the page Live.")
        return
    rows = [
        (
            one.name,
            str(one.pid),
            share.of(one.pid, one.cpu_s, now_s),
            f"{one.cpu_s:.1f} s",
            _megabytes(one.memory_bytes),
            "-" if one.restarts is None else str(one.restarts),
            one.log.rpartition("\n")[2],
            one.bus,
        )
        for one in found
    ]
    heads = ("node", "pid", "processor", "processor time", "memory", "restarts", "end of its log", "bus")
    table("Nodes", heads, rows, heads[1:6])


def _processes(found: Sequence[ProcessInfo], share: ProcessorShare, now_s: float) -> None:
    rows = [
        (
            one.name,
            str(one.pid),
            _STATES.get(one.state, one.state),
            share.of(one.pid, one.cpu_s, now_s),
            f"{one.cpu_s:.1f} s",
            _megabytes(one.memory_bytes),
            one.campaign,
        )
        for one in found
    ]
    heads = ("process", "pid", "state", "processor", "processor time", "memory", "flies")
    table("Processes of the service", heads, rows, ("pid", "processor", "processor time", "memory"))


def _stacks(found: Sequence[StackView]) -> None:
    if not found:
        nothing("No stack is up.", "zenfi up keeps this service, and nodes of yours, running.")
    for one in found:
        ui.label(f"{one.name} on {one.host}, pid {one.pid}").classes("heading")
        rows = [
            (
                process.name,
                process.phase.replace("_", " "),
                str(process.pid or "-"),
                str(process.restarts),
                f"{process.cpu_percent:.0f} %",
                _megabytes(process.memory_bytes),
                process.reason,
            )
            for process in one.processes
        ]
        heads = ("process", "state", "pid", "restarts", "processor", "memory", "")
        table(one.name, heads, rows, ("pid", "restarts", "processor", "memory"))
        lines = tail({process.name: process.log for process in one.processes}, LOG_LINES)
        log("\n".join(f"{name}: {line}" for name, line in lines[-LOG_LINES:]), f"Log of {one.name}")
