"""Where a campaign is flown: the forms of its specification."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from services.models.base import Strict


class _Form(Strict):
    """One of several forms: its ``kind`` is also told by who leaves out what was not set."""

    def model_post_init(self, _: Any, /) -> None:
        self.model_fields_set.add("kind")


class LocalSpec(_Form):
    """On this machine's processors."""

    kind: Literal["local"] = "local"


class DaskSpec(_Form):
    """On a Dask cluster that is there already; certificates for ``tls`` come from Dask's configuration."""

    kind: Literal["dask"] = "dask"
    address: str = Field(pattern=r"^(tcp|tls)://[^\s/]+:\d{1,5}$", description="of its scheduler")


class SlurmSpec(_Form):
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
