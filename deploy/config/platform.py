"""Compute platforms: the virtual latency of each kernel, as data in ``deploy/platforms``."""

from __future__ import annotations

import tomllib
from functools import cache
from importlib.resources import files

from services.kernels import KERNELS, is_planner
from services.models.detection import DetectorSpec
from services.models.platform import KernelLatency, PlatformDefinition
from services.system import plug_ins


class BadPlatformError(ValueError):
    """No platform of that name, or one that leaves out a kernel."""


def platform_names() -> list[str]:
    """The platforms that come along, sorted."""
    names = (entry.name for entry in (files("deploy") / "platforms").iterdir())
    return sorted(name.removesuffix(".toml") for name in names if name.endswith(".toml"))


@cache
def _named(name: str) -> PlatformDefinition:
    text = (files("deploy") / "platforms" / f"{name}.toml").read_text()
    return PlatformDefinition.model_validate(tomllib.loads(text))


def load_platform(asked: str | PlatformDefinition) -> PlatformDefinition:
    """The platform of that name, or the definition itself, with a latency for every kernel.

    :raises BadPlatformError: if there is no such name, or a kernel is missing or unknown.
    """
    if asked == "host":
        message = "platform 'host' is this machine: measure it with `zenfi bench kernels`, then give its file"
        raise BadPlatformError(message)
    if isinstance(asked, str) and asked not in platform_names():
        message = f"unknown platform {asked!r}; known: {', '.join(platform_names())}"
        raise BadPlatformError(message)
    platform = _named(asked) if isinstance(asked, str) else asked
    missing = [kernel for kernel in KERNELS if kernel not in platform.kernels]
    unknown = [kernel for kernel in platform.kernels if kernel not in KERNELS and not is_planner(kernel)]
    if missing or unknown:
        message = f"platform {platform.name}: " + (
            f"no latency for {', '.join(missing)}" if missing else f"unknown kernel {', '.join(unknown)}"
        )
        raise BadPlatformError(message)
    return platform


def latencies(asked: str | PlatformDefinition, planner: str) -> dict[str, KernelLatency]:
    """The latency of each kernel, that of a ``planner`` which another package adds among them.

    :raises BadPlatformError: as :func:`load_platform`, or if the planner names no kernel for its latency.
    """
    kernels = load_platform(asked).kernels
    if planner in kernels:
        return kernels
    stands_for = plug_ins.load("planners", planner).latency_as
    if stands_for not in kernels:
        message = f"planner {planner!r}: latency_as {stands_for!r} is no kernel; known: {', '.join(KERNELS)}"
        raise BadPlatformError(message)
    return {**kernels, planner: kernels[stands_for]}


def check_latency(asked: str | PlatformDefinition, detector: DetectorSpec) -> KernelLatency:
    """The latency of one check of a detector.

    :raises BadPlatformError: if neither the detector's specification nor the platform states it.
    """
    if detector.check_us is not None:
        return KernelLatency(mean_ms=detector.check_us / 1e3)
    platform = load_platform(asked)
    if detector.scheme not in platform.detectors:
        message = f"platform {platform.name}: no latency for detector {detector.scheme}: give its check_us"
        raise BadPlatformError(message)
    return platform.detectors[detector.scheme]
