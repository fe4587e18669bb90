"""Compute platforms: the virtual latency of each kernel, as data in ``deploy/platforms``."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from importlib.resources import files

from pydantic import Field, ValidationError

from services.bus.mission import Strict
from services.kernels import KERNELS


class UnknownPlatformError(ValueError):
    """No platform of that name is declared."""


class Platform(Strict):
    """A companion computer. ``latency_ms`` is by kernel."""

    name: str
    source: str
    latency_ms: dict[str, float] = Field(min_length=1)

    def latencies_ns(self) -> Mapping[str, int]:
        """Virtual latency of every kernel of the table, in nanoseconds."""
        return {kernel: round(self.latency_ms[kernel] * 1e6) for kernel in KERNELS}


def platform_names() -> list[str]:
    """The declared platforms, sorted."""
    folder = files("deploy") / "platforms"
    return sorted(
        entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml")
    )


def load_platform(name: str) -> Platform:
    """The platform of that name.

    :raises UnknownPlatformError: if there is none.
    :raises ValueError: if its file is malformed or forgets a kernel.
    """
    if name not in platform_names():
        message = f"unknown platform {name!r}; known: {', '.join(platform_names())}"
        raise UnknownPlatformError(message)
    text = (files("deploy") / "platforms" / f"{name}.toml").read_text()
    try:
        platform = Platform.model_validate(tomllib.loads(text))
    except (ValidationError, tomllib.TOMLDecodeError) as error:
        message = f"platform {name}: {error}"
        raise ValueError(message) from error
    forgotten = [kernel for kernel in KERNELS if kernel not in platform.latency_ms]
    if forgotten:
        message = f"platform {name}: no latency for {', '.join(forgotten)}"
        raise ValueError(message)
    return platform
