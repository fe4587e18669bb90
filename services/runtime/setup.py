"""The setup that a node is given when it is started."""

from __future__ import annotations

from pathlib import Path

from services.models.base import Strict
from services.models.mission import MissionSpec
from services.models.platform import KernelLatency


class NodeSetup(Strict):
    """The part in a mission of one process, with which it starts or restarts.

    ``life`` counts its restarts, ``start_ns`` is the virtual time at which it is there, ``published``
    says how many messages of its topics exist, ``resume_from`` where its inputs begin; ``clock`` is the
    page of the flight's clock in real time. ``plug_ins`` says where those are that the mission uses
    (:func:`services.system.plug_ins.tell`). ``true_path`` is the file to which the simulator writes its true
    state, beside the bus.
    """

    name: str
    spec: MissionSpec
    kernels: list[str]
    latencies: dict[str, KernelLatency]
    expected: list[str]
    life: int = 0
    start_ns: int = 0
    published: dict[str, int] = {}
    resume_from: dict[str, int] = {}
    clock: Path | None = None
    plug_ins: dict[str, str] = {}
    true_path: Path | None = None
