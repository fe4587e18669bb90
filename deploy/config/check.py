"""The boundary check of a mission: every name in a specification must be declared in its table."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Sequence
from itertools import takewhile
from pathlib import Path

from deploy.config.platform import check_latency, latencies
from deploy.config.plug_ins import used_plug_ins
from deploy.errors import BadSpecError
from detector.errors import DetectionInputError
from detector.schemes.registry import in_flight
from injector.capabilities import check as preflight
from injector.isa.host import AbsentError, require
from services.kernels import GOAL_KERNELS, KERNELS, PLANNERS, Kernel, aimed_at, find_kernel, is_planner
from services.models.faults.specification import FaultSpec
from services.models.inter_kernel_states import GROUPS, STATES, members
from services.models.mission import MissionSpec
from services.models.oracles.properties import refuse_unknown_signal
from services.models.own_stack import OwnStack, OwnStage
from services.models.pilots import ALL_GUARDS, find_guard
from services.runtime.source_fault import eligible
from services.system import plug_ins
from services.system.shared_stats import MAX_GUARDS
from sim.mission.area import corners
from sim.vehicle.airframe import airframe
from sim.world import make_world

LAUNCHERS = ("env", "sh", "bash", "dash", "zsh", "ksh")
"""What runs a script that starts a program: pyenv's ``python3`` is one of bash."""


def check(spec: MissionSpec) -> None:
    """Refuse what cannot be flown, before anything is started.

    :raises BadSpecError: naming the field and what would be right.
    """
    if not is_planner(spec.planner):
        raise BadSpecError(plug_ins.unknown("planners", spec.planner, PLANNERS))
    try:
        _check_plug_ins(spec)
        world = make_world(spec.world, spec.seed)
        if spec.mission != "navigation":
            corners(spec.area, world)
        airframe(spec.airframe)
        latencies(spec.platform, spec.planner)
        if spec.detector is not None:
            in_flight(spec.detector)
            check_latency(spec.platform, spec.detector)
    except (ValueError, DetectionInputError) as error:
        raise BadSpecError(str(error)) from error
    if spec.clock != "lockstep" and not spec.link.is_ideal:
        raise BadSpecError("link: it delays and loses in virtual time: leave out --clock realtime")
    if spec.stack is not None:
        _check_stack(spec.stack, spec)
    if spec.fault is not None and spec.fault.level == "source":
        _check_source(spec.fault)
    elif spec.fault is not None and spec.fault.level == "instruction":
        _check_instruction(spec.fault, spec)


def _check_plug_ins(spec: MissionSpec) -> None:
    """Refuse what no table declares and no other package adds, or what cannot be imported.

    :raises ValueError: in one line.
    """
    for name in spec.active_guards:
        find_guard(name)
    added = spec.active_guards - ALL_GUARDS
    if len(ALL_GUARDS) + len(added) > MAX_GUARDS:
        message = (
            f"guards: {len(added)} of other packages; at most {MAX_GUARDS - len(ALL_GUARDS)} act at once"
        )
        raise ValueError(message)
    for text in spec.properties:
        refuse_unknown_signal(text)
    for place in used_plug_ins(spec):
        kind, _, name = place.partition("/")
        plug_ins.load(kind, name)


def _check_stack(stack: OwnStack, spec: MissionSpec) -> None:
    if spec.clock != "lockstep":
        raise BadSpecError("stack: a stack of one's own flies in virtual time: leave out --clock realtime")
    for replaced, own in stack.programs.items():
        if digest_of(own.command, Path(own.folder)) != own.sha256:
            message = f"stack: {replaced}: {own.command[0]} is not what it was when it was specified"
            raise BadSpecError(message)
        if (option := _randomising(own.command)) is not None:
            message = (
                f"stack: {replaced}: with {option}, Python hashes strings by a random number, so no flight "
                "would repeat: leave it out"
            )
            raise BadSpecError(message)


def _randomising(command: Sequence[str]) -> str | None:
    """The option in a command of Python's by which it ignores the environment, PYTHONHASHSEED too."""
    if not Path(command[0]).name.startswith("python"):
        return None
    options = takewhile(lambda word: word.startswith("-") and word[:2] not in ("-c", "-m"), command[1:])
    return next((word for word in options if word[1:2] not in "WX" and set(word) & set("IE")), None)


def digest_of(command: Sequence[str], folder: Path) -> str:
    """SHA-256 of a command's executable and of whatever else in it is a file, one after the other.

    :raises BadSpecError: if it cannot be run.
    """
    digest = hashlib.sha256()
    for number, word in enumerate(command):
        file = folder / word
        if number and not file.is_file():
            continue
        try:
            content = file.read_bytes()
        except OSError as error:
            message = f"stack: {file}: {error.strerror}"
            raise BadSpecError(message) from error
        if not number and not (content.startswith(b"\x7fELF") and os.access(file, os.X_OK)):
            message = f"stack: {file} is no program that can be run"
            raise BadSpecError(message)
        digest.update(content)
    return digest.hexdigest()


def _check_source(fault: FaultSpec) -> None:
    _known("inter-kernel state", fault.target, [*STATES, *GROUPS])
    for state in members(fault.target):
        if not eligible(fault, state):
            kind = f"{state.width_bits}-bit {'floating-point' if state.floating else 'integer'} number"
            message = f"fault: {state.name} is a {kind}: it has no such bits"
            raise BadSpecError(message)


def _check_instruction(fault: FaultSpec, spec: MissionSpec) -> None:
    target = fault.target
    own = spec.own_stage(aimed_at(fault))
    if own is not None:
        _check_program(fault, own)
        return
    check_kernel(target)
    if fault.recurs_in_instructions:
        _check_recurrence(fault, spec)
    if is_planner(target) and target != spec.planner:
        message = f"kernel {target!r} never runs with planner {spec.planner!r}: choose --planner {target}"
        raise BadSpecError(message)
    if target in GOAL_KERNELS.values() and target != GOAL_KERNELS.get(spec.mission):
        message = f"kernel {target!r} never runs in mission {spec.mission!r}"
        raise BadSpecError(message)
    check_machine(fault)


def _check_recurrence(fault: FaultSpec, spec: MissionSpec) -> None:
    if spec.clock != "lockstep":
        message = f"fault: recurrence {fault.recurrence} flies in virtual time: leave out --clock realtime"
        raise BadSpecError(message)
    if fault.recurrence == "rate" and not latencies(spec.platform, spec.planner)[fault.target].mean_ms:
        message = f"fault: {fault.target} takes no time on this platform, so no upset comes in it"
        raise BadSpecError(message)


def _check_program(fault: FaultSpec, own: OwnStage) -> None:
    stage = aimed_at(fault)
    if fault.target != stage:
        message = f"kernel {fault.target!r} never runs: the stack has a program for {stage}; strike {stage!r}"
        raise BadSpecError(message)
    if not own.function:
        message = f"stack: {stage} names no function, so no instruction of it can be struck"
        raise BadSpecError(message)
    if (launcher := Path(own.command[0]).name) in LAUNCHERS:
        message = (
            f"stack: {stage}: {' '.join(own.command)}: {launcher} only starts another program, so that one "
            "would not be struck: name it in the command (of pyenv's launchers, what `pyenv which NAME` says)"
        )
        raise BadSpecError(message)
    if fault.recurs_in_instructions:
        raise BadSpecError(f"fault: recurrence {fault.recurrence} goes with our own kernels, not programs")
    if fault.scope == "kernel":
        raise BadSpecError("fault: scope kernel goes with our own kernels; of a program, the call is struck")
    check_machine(fault)


def check_machine(fault: FaultSpec) -> None:
    """Refuse an instruction-level fault that this machine cannot inject.

    :raises BadSpecError: naming what it lacks and the remedy.
    """
    try:
        require(fault)
    except AbsentError as error:
        raise BadSpecError(str(error)) from error
    for finding in preflight():
        if not finding.ok:
            message = f"cannot inject: {finding.name}: {finding.remedy}"
            raise BadSpecError(message)


def check_kernel(name: str) -> Kernel:
    """The kernel of that name: one of ours, or a planner that another package adds.

    :raises BadSpecError: if there is none, naming those that are.
    """
    try:
        kernel = find_kernel(name)
    except plug_ins.UnknownPlugInError as error:
        raise BadSpecError(str(error)) from error
    if kernel is None:
        message = f"unknown kernel {name!r}; known: {', '.join((*KERNELS, *plug_ins.names('planners')))}"
        raise BadSpecError(message)
    return kernel


def _known(what: str, name: str, table: Iterable[str]) -> None:
    names = list(table)
    if name not in names:
        message = f"unknown {what} {name!r}; known: {', '.join(names)}"
        raise BadSpecError(message)
