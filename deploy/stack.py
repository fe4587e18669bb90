"""The table of processes: the only place where a mission's processes are declared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True, slots=True)
class Process:
    """One process of a mission.

    ``module`` holds ``main``; a process is ``essential`` if the mission cannot go on without it (it
    is then not restarted), and runs only ``with_fault`` if it is needed for nothing else.
    """

    name: str
    module: str
    essential: bool = False
    with_fault: bool = False


_TABLE = (
    # First, so that the nodes can name it as their tracer.
    Process("injector", "injector.node", essential=True, with_fault=True),
    Process("sim", "sim.node", essential=True),
    Process("perception", "services.perception.node"),
    Process("planning", "services.planning.node"),
    Process("control", "services.control.node"),
)

STACK: Mapping[str, Process] = MappingProxyType({process.name: process for process in _TABLE})
