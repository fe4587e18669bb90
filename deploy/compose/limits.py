"""Limits of what processes use: which of them this machine can hold, and who is over its memory."""

from __future__ import annotations

import os
import resource
from collections.abc import Mapping

from deploy.compose.folder import StackError
from deploy.compose.process import SupervisedProcess
from deploy.compose.stack_file import ProcessSpec
from services.system.process_stat import proportional_memory_bytes


class ImpossibleLimitError(StackError):
    """A limit that is declared cannot be held on this machine."""


def check(processes: Mapping[str, ProcessSpec]) -> None:
    """Refuse limits that could not be held, before anything is started.

    :raises ImpossibleLimitError: naming the process, the limit and what is possible.
    """
    _, files = resource.getrlimit(resource.RLIMIT_NOFILE)
    possible = {"memory_bytes": os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")}
    if files != resource.RLIM_INFINITY:
        possible["open_files"] = files
    for name, spec in processes.items():
        for limit, most in possible.items():
            wanted = getattr(spec.limits, limit)
            if wanted is not None and wanted > most:
                message = f"processes.{name}.limits.{limit}: {wanted} is more than there are here: {most}"
                raise ImpossibleLimitError(message)


def over_memory(process: SupervisedProcess) -> str:
    """That a family is over its limit of memory, in words; empty if it is not.

    Pages that several processes share count once: how much each has alone is asked only if what all of
    them have, shared pages with each, is over the limit.
    """
    limit = process.spec.limits.memory_bytes
    if limit is None:
        return ""
    family = process.family()
    if sum(stat.memory_bytes for stat in family.values()) <= limit:
        return ""
    used = sum(proportional_memory_bytes(pid, stat) for pid, stat in family.items())
    return f"over its limit of memory: {used / 1e6:.0f} of {limit / 1e6:.0f} MB" if used > limit else ""
