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

from injector.block_profile.counted_call import UncountableError
from injector.block_profile.instruction_counts import (
    FEW_PASSES,
    DynamicInstruction,
    Way,
    way_from_the_beginning,
)
from injector.faults.call_profile import CallProfile, counted_call
from injector.faults.record import exact_site
from injector.flight.probe import ProbeRun
from injector.tracing.compiled_functions import compiled_functions
from injector.tracing.elf import place
from injector.tracing.process import Process
from services.kernels import scope_of
from services.models.faults.specification import FaultSpec, Site, Trigger, Waypoint
from services.runtime.kernel_timer import GATE_SIGNAL

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
            drawn, site, leaders = _draw(probe, fault, draw)
        if drawn.hit > FEW_PASSES:
            with probes() as probe:
                site = _with_a_way(probe, fault, drawn, site, leaders)
    except UncountableError:
        with probes() as probe:
            took_ns = probe.run()
        return trigger.model_copy(update={"cpu_ns": int(draw.random() * took_ns)})
    return trigger.model_copy(update={"site": site})


def _draw(
    probe: ProbeRun, fault: FaultSpec, draw: np.random.Generator
) -> tuple[DynamicInstruction, Site, frozenset[int]]:
    profile = CallProfile(probe.thread, probe.process, fault, GATE_SIGNAL, compiled_functions())
    drawn = profile.draw(draw)
    if drawn is None:
        executed, scope = profile.counts.executed, scope_of(fault)
        message = f"none of the call's {executed} instructions in scope {scope} is eligible"
        raise NothingEligibleError(message)
    site = exact_site(profile.places.at(drawn.address), drawn.hit)
    return drawn, site, profile.counts.leaders


def _with_a_way(
    probe: ProbeRun, fault: FaultSpec, drawn: DynamicInstruction, site: Site, leaders: frozenset[int]
) -> Site:
    call = counted_call(
        probe.thread,
        probe.process,
        fault,
        leaders=leaders,
        stops={drawn.address: [drawn.hit]},
    )
    if call.to_next_stop(GATE_SIGNAL) is None:
        raise UncountableError("the call ended before the pass that another copy made")
    way = way_from_the_beginning(call.counts(), drawn)
    if way is None:
        return site
    return site.model_copy(update={"way": waypoint(probe.process, way)})


def waypoint(process: Process, way: Way) -> Waypoint:
    """A way through a process's code, told so that it can be gone in another one."""
    there = place(process.pid, process.maps(), way.address, compiled_functions())
    return Waypoint(
        module=there.module, build_id=there.build_id, offset=there.offset, hit=way.hit, rest=way.rest
    )
