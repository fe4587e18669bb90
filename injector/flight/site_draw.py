"""The draw of the dynamic instruction that a fault strikes: each eligible one of a call is equally likely.

A probe counts how often the call executes each instruction of the fault's scope
(:mod:`injector.block_profile`). One of those that the fault can strike is drawn from the fault's seed and
nothing else, so that the same specification strikes the same instruction in every flight. If it is a late
pass through its address, another probe tells from where there are fewer to count.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager

import numpy as np

from injector.block_profile.counted_call import CountedCall, UncountableError
from injector.block_profile.instruction_counts import (
    DynamicInstruction,
    InstructionCounts,
    draw_instruction,
    shortest_way,
)
from injector.faults.code_scope import countable_code
from injector.faults.eligibility import is_eligible
from injector.flight.probe import ProbeRun
from injector.isa.host import decode
from injector.isa.instruction import DecodeError
from injector.tracing.compiled_functions import compiled_functions
from injector.tracing.elf import CodeLocations, place
from services.kernels import scope_of
from services.models.fault_spec import FaultSpec, Site, Trigger, Waypoint
from services.runtime.kernel_timer import GATE_SIGNAL

FEW_PASSES = 2_000
"""Passes through an address that are counted from the call's beginning: some 20 ms."""

Probes = Callable[[], AbstractContextManager[ProbeRun]]


class NothingEligibleError(Exception):
    """The call executes no instruction that the fault can strike: one line."""


def draw_site(probes: Probes, fault: FaultSpec, trigger: Trigger, draw: np.random.Generator) -> Trigger:
    """Draw where in a call a fault strikes; each probe that ``probes`` yields stands at its beginning.

    Of a call that cannot be counted (an exception of C++ passes through its code) a moment of its thread time
    is drawn, which repeats only nearly.

    :raises NothingEligibleError: if there is nothing to strike.
    """
    try:
        with probes() as probe:
            drawn, site, counts = _draw(probe, fault, draw)
        if drawn.hit > FEW_PASSES:
            with probes() as probe:
                site = _with_a_way(probe, fault, drawn, site, counts)
    except UncountableError:
        with probes() as probe:
            took_ns = probe.run()
        return trigger.model_copy(update={"cpu_ns": int(draw.random() * took_ns)})
    return trigger.model_copy(update={"site": site})


def _draw(
    probe: ProbeRun, fault: FaultSpec, draw: np.random.Generator
) -> tuple[DynamicInstruction, Site, InstructionCounts]:
    call = CountedCall(probe.thread, probe.process, countable_code(fault, probe.process))
    blocks = call.run(GATE_SIGNAL)
    places = CodeLocations(probe.process.pid, probe.process.maps(), compiled_functions())
    # By names and offsets, not by addresses: the draw is the same where memory lies elsewhere.
    counts = InstructionCounts.of(blocks, order=places.named)

    def eligible(address: int) -> bool:
        try:
            return is_eligible(fault, decode(call.code_at(address), address))
        except DecodeError:
            return False

    drawn = draw_instruction(counts, eligible, draw)
    if drawn is None:
        message = f"none of the call's {counts.executed} instructions in scope {scope_of(fault)} is eligible"
        raise NothingEligibleError(message)
    there = places.at(drawn.address)
    site = Site(
        precision="exact",
        module=there.module,
        build_id=there.build_id,
        offset=there.offset,
        hit=drawn.hit,
    )
    return drawn, site, counts


def _with_a_way(
    probe: ProbeRun, fault: FaultSpec, drawn: DynamicInstruction, site: Site, counts: InstructionCounts
) -> Site:
    call = CountedCall(
        probe.thread,
        probe.process,
        countable_code(fault, probe.process),
        leaders=counts.leaders | {drawn.address},
        stop=(drawn.address, drawn.hit),
    )
    way = shortest_way(call.run(GATE_SIGNAL), drawn)
    if way is None:
        return site
    there = place(probe.process.pid, probe.process.maps(), way.address, compiled_functions())
    waypoint = Waypoint(
        module=there.module, build_id=there.build_id, offset=there.offset, hit=way.hit, rest=way.rest
    )
    return site.model_copy(update={"way": waypoint})
