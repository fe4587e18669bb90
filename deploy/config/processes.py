"""The table of processes: the only place where a mission's processes are declared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal


@dataclass(frozen=True, slots=True)
class ProcessDeclaration:
    """The declaration of one process of a mission: its name and how it is run.

    ``module`` holds ``main``; a process is ``essential`` if the mission cannot go on without it (it
    is then not restarted), and runs only ``with_fault`` or ``with_detector`` if it is needed for nothing
    else. Without its detector a mission goes on, and it is not started again. A ``sidecar`` is no stage:
    it has no proxy and opens a session of its own. ``host`` is where it runs if there are two.
    """

    name: str
    module: str
    essential: bool = False
    with_fault: bool = False
    sidecar: bool = False
    with_detector: bool = False
    with_strikes: bool = False
    host: Literal["simulator", "companion"] = "companion"


_TABLE = (
    ProcessDeclaration("striker", "injector.strikes.node", sidecar=True, with_strikes=True),
    # First, so that the nodes can name it as their tracer.
    ProcessDeclaration("injector", "injector.node", essential=True, with_fault=True, sidecar=True),
    ProcessDeclaration("sim", "sim.node", essential=True, host="simulator"),
    ProcessDeclaration("perception", "services.perception.node"),
    ProcessDeclaration("planning", "services.planning.node"),
    ProcessDeclaration("control", "services.control.node"),
    # Last, so that at the end no stage outlives it.
    ProcessDeclaration("detector", "detector.node", with_detector=True, sidecar=True),
)

STACK: Mapping[str, ProcessDeclaration] = MappingProxyType({process.name: process for process in _TABLE})

FOREIGN = "services.foreign.node"
"""The module that runs instead of a stage's where the mission's own stack names an executable for it."""
