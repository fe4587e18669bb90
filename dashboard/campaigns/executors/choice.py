"""Which executor flies a campaign: the one place that knows them all."""

from __future__ import annotations

import importlib
import os
import re
from contextlib import closing
from pathlib import Path
from types import ModuleType
from typing import assert_never

from pydantic import ValidationError

from dashboard.campaigns.executors.executor import Executor, Ordering, unrecorded
from dashboard.campaigns.executors.local import LocalExecutor
from dashboard.campaigns.executors.spec import DaskSpec, ExecutorSpec, LocalSpec, SlurmSpec
from deploy.errors import BadSpecError, one_line

FORM = "local|dask://HOST:PORT|tls://HOST:PORT|slurm:FOLDER"


def parse_executor(text: str, of_file: ExecutorSpec) -> ExecutorSpec:
    """The executor in words, as :data:`FORM`; ``dask`` and ``slurm`` alone mean the campaign file's.

    :raises BadSpecError: if it is none.
    """
    if text == of_file.kind:
        return of_file
    try:
        if text == "local":
            return LocalSpec()
        if match := re.fullmatch(r"(dask|tcp|tls)://(.+)", text):
            scheme = "tcp" if match[1] == "dask" else match[1]
            return DaskSpec(address=f"{scheme}://{match[2]}")
        if text.startswith("slurm:"):
            return SlurmSpec(folder=text.removeprefix("slurm:"))
    except ValidationError as error:
        message = f"--executor {text}: {one_line(error)}"
        raise BadSpecError(message) from error
    message = f"--executor {text}: expected {FORM}; dask or slurm alone: as the campaign's file says"
    raise BadSpecError(message)


def open_executor(
    spec: ExecutorSpec, slots: int | None, lease_s: float, logs: Path | None, order: Ordering = unrecorded
) -> Executor:
    """The executor, ready to fly; ``logs`` is the folder for what local workers print.

    ``order`` is for local workers, too: on other machines nobody is asked to write files of ours.

    :raises BadSpecError: if what it needs is not there.
    """
    match spec:
        case LocalSpec():
            return LocalExecutor(slots, lease_s, logs, order)
        case DaskSpec():
            executor: Executor = _module("dask").DaskExecutor(spec.address, slots, lease_s)
        case SlurmSpec():
            executor = _module("slurm").SlurmExecutor(spec, slots, lease_s)
        case _:
            assert_never(spec)
    return executor


def slots_of(spec: ExecutorSpec, slots: int | None, lease_s: float) -> int:
    """How many flights at a time there will be; nothing is started.

    :raises BadSpecError: if what it needs is not there.
    """
    if isinstance(spec, LocalSpec):
        return slots or len(os.sched_getaffinity(0))
    with closing(open_executor(spec, slots, lease_s, None)) as executor:
        return executor.slots


def _module(kind: str) -> ModuleType:
    try:
        return importlib.import_module(f"dashboard.campaigns.executors.{kind}")
    except ModuleNotFoundError as error:
        message = f"executor {kind}: {error.name} is not installed: pip install 'zenfi[{kind}]'"
        raise BadSpecError(message) from error
