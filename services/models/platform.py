"""What a compute platform is: the one definition, shared by files, specifications and nodes."""

from __future__ import annotations

from pydantic import Field

from services.models.base import Strict


class KernelLatency(Strict):
    """The latency of one kernel on a platform, as a distribution.

    Of ``mean_ms`` a part 1 - ``jitter`` is certain, the rest exponentially distributed: a hard lower
    bound, the stated mean, and a standard deviation of ``jitter`` times the mean.
    """

    mean_ms: float = Field(ge=0, le=60_000)
    jitter: float = Field(default=0.0, ge=0, lt=1)


class PlatformDefinition(Strict):
    """A companion computer: the latency of each kernel, and of a check of each detection scheme.

    ``source`` says where the figures come from.
    """

    name: str = Field(min_length=1, max_length=60)
    source: str
    kernels: dict[str, KernelLatency] = Field(min_length=1)
    detectors: dict[str, KernelLatency] = {}
