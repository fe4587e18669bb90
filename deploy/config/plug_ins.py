"""The plug-ins that a mission uses: what its nodes are told, so that none need look for it."""

from __future__ import annotations

from services.kernels import KERNELS
from services.models.mission import MissionSpec
from services.models.pilots import GUARDS, PILOTS
from services.models.world import GeneratedWorld
from services.system import plug_ins
from sim.world import definition


def used_plug_ins(spec: MissionSpec) -> dict[str, str]:
    """Where each plug-in is that a mission uses, by ``KIND/NAME``; detectors are found by their node.

    :raises UnknownPlugInError: if one is not installed.
    """
    used = []
    if spec.planner not in KERNELS:
        used.append(("planners", spec.planner))
    if spec.pilot not in PILOTS:
        used.append(("pilots", spec.pilot))
    used += [("guards", name) for name in sorted(spec.active_guards) if name not in GUARDS]
    world = definition(spec.world) if isinstance(spec.world, str) else spec.world
    if isinstance(world, GeneratedWorld):
        used.append(("worlds", world.generator))
    return {f"{kind}/{name}": plug_ins.reference(kind, name) for kind, name in used}
