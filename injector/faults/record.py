"""The record of an injection, built from what came of the attempt and where it was made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from injector.faults.stopped_thread import InjectionResult
from injector.tracing.elf import CodeLocation
from services.kernels import scope_of
from services.models.faults.specification import FaultSpec, Site
from services.models.outcome import InjectionRecord


def exact_site(where: CodeLocation, hit: int) -> Site:
    """The dynamic instruction that was drawn: the ``hit``-th pass through a place."""
    return Site(precision="exact", module=where.module, build_id=where.build_id, offset=where.offset, hit=hit)


def record_of(
    result: InjectionResult,
    fault: FaultSpec,
    *,
    node: str,
    kernel: str,
    invocation: int,
    location: Callable[[int], CodeLocation] | None = None,
    **circumstances: Any,
) -> InjectionRecord:
    """Build the record of an attempt to inject ``fault``, whether or not it was injected.

    ``location`` tells where the address of the instruction lies; it is asked only if there is one.
    ``circumstances`` are other fields of the record: precision, trigger, pid, tid, pause and so on.
    """
    record = InjectionRecord(
        status=result.status,
        node=node,
        kernel=kernel,
        invocation=invocation,
        model=fault.model,
        scope=scope_of(fault),
        **circumstances,
    )
    changed = _described(result)
    if result.instruction is not None and location is not None:
        changed |= asdict(location(result.instruction.address))
    return record.model_copy(update=changed)


def _described(result: InjectionResult) -> dict[str, Any]:
    """The fields of the record that tell what was corrupted and what was read back."""
    told: dict[str, Any] = {"reason": result.reason, "resampled": result.passed_over}
    if result.instruction is not None:
        told |= {"instruction_bytes": result.instruction.code.hex(), "instruction": result.instruction.text}
    if not result.bits:
        return told
    for name in (
        "operand",
        "address",
        "width_bits",
        "element_bits",
        "instruction_after",
        "held_instructions",
    ):
        told[name] = getattr(result, name)
    told |= {"register_name": result.register, "bits": list(result.bits)}
    digits = -(-result.width_bits // 4)
    return told | {name: f"{getattr(result, name):0{digits}x}" for name in ("before", "after", "read_back")}
