"""The platform ``host``: this machine's latency for every kernel, measured in golden flights."""

from __future__ import annotations

import json
import platform as machine
from collections import defaultdict
from math import sqrt
from typing import Any

from deploy.errors import InfrastructureError
from deploy.mission.flight import fly
from deploy.mission.fork_server import ForkServer
from detector.schemes.registry import with_models
from services.kernels import KERNELS, PLANNERS
from services.models.mission import MissionSpec
from services.models.outcome import KernelUse
from services.models.platform import KernelLatency, PlatformDefinition

_MOST_JITTER = 0.95
"""A longer tail than an exponential with no lower bound cannot be stated."""


def measure(server: ForkServer, flights: int) -> PlatformDefinition:
    """Fly golden flights in Dense with each planner, of each mission that has a kernel of its own, and with
    each detector; mean and deviation of the thread time of each kernel's calls and each detector's checks.

    :raises InfrastructureError: if a kernel never ran.
    """
    uses: dict[str, list[KernelUse]] = defaultdict(list)
    detectors = with_models()
    asked: list[dict[str, Any]] = [{"planner": planner} for planner in PLANNERS]
    asked += [{"mission": mission} for mission in ("scanning", "mapping")]  # the kernels that choose goals
    asked += [{"detector": {"scheme": scheme, "check_us": 0}} for scheme in detectors]
    for fields in asked:
        for seed in range(flights):
            spec = MissionSpec.model_validate({"world": "dense", "seed": seed, **fields})
            outcome = fly(spec, server).outcome
            for report in outcome.nodes.values():
                for kernel, use in report.kernels.items():
                    uses[kernel].append(use)
    missing = [kernel for kernel in KERNELS if not uses[kernel]]
    if missing:
        message = f"{', '.join(missing)} never ran in {flights} flights per planner and mission"
        raise InfrastructureError(message)
    source = (
        f"Measured on this {machine.machine()} machine: thread time,"
        f" flights per planner, mission and detector in Dense: {flights}."
    )
    return PlatformDefinition(
        name="host",
        source=source,
        kernels={kernel: latency(uses[kernel]) for kernel in KERNELS},
        detectors={scheme: latency(uses[scheme]) for scheme in detectors},
    )


def latency(uses: list[KernelUse]) -> KernelLatency:
    """Mean and deviation over all calls of a kernel."""
    calls = sum(use.invocations for use in uses)
    mean_ns = sum(use.cpu_ns for use in uses) / calls
    variance = max(sum(use.cpu_squares_ns2 for use in uses) / calls - mean_ns**2, 0.0)
    jitter = min(sqrt(variance) / mean_ns, _MOST_JITTER) if mean_ns else 0.0
    return KernelLatency(mean_ms=round(mean_ns / 1e6, 6), jitter=round(jitter, 3))


def to_toml(platform: PlatformDefinition) -> str:
    """The text of a platform file, in TOML."""
    lines = [f"name = {json.dumps(platform.name)}", f"source = {json.dumps(platform.source)}"]
    for table, stated in (("kernels", platform.kernels), ("detectors", platform.detectors)):
        lines += ["", f"[{table}]"]
        lines += [
            f"{name} = {{ mean_ms = {one.mean_ms}, jitter = {one.jitter} }}" for name, one in stated.items()
        ]
    return "\n".join([*lines, ""])
