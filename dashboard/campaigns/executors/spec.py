"""Where a campaign is flown: the forms of its specification."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from services.models.base import Strict


class LocalSpec(Strict):
    """On this machine's processors."""

    kind: Literal["local"] = "local"


class DaskSpec(Strict):
    """On a Dask cluster that is there already; certificates for ``tls`` come from Dask's configuration."""

    kind: Literal["dask"] = "dask"
    address: str = Field(pattern=r"^(tcp|tls)://[^\s/]+:\d{1,5}$", description="of its scheduler")


class SlurmSpec(Strict):
    """As SLURM jobs, each of which flies a shard in one slot and writes into ``folder``."""

    kind: Literal["slurm"] = "slurm"
    folder: str = Field(pattern=r"^/", description="that the machines share")
    shard: int = Field(default=100, ge=1, le=10_000, description="runs that a job should have")
    jobs: int = Field(default=16, ge=1, le=10_000, description="at a time")
    minutes: int = Field(default=60, ge=1, description="time limit of a job")
    memory_gb: int = Field(default=4, ge=1, description="of a job")
    partition: str | None = Field(default=None, pattern=r"^[\w.,-]+$")
    account: str | None = Field(default=None, pattern=r"^[\w.-]+$")


ExecutorSpec = Annotated[LocalSpec | DaskSpec | SlurmSpec, Field(discriminator="kind")]
