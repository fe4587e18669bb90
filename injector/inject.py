"""The act: one bit of one register of one instruction."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from injector.decode import Candidate, DecodeError, Instruction, decode
from injector.freeze import Thread, Tracees
from injector.process import CodeError, Process
from injector.ptrace import GoneError
from injector.registers import Registers
from injector.x86_64 import X8664Registers
from services.bus.mission import FaultSpec

SITES = 1000
"""Instructions without an eligible register that are passed over before we give up."""


@dataclass(frozen=True, slots=True)
class Strike:
    """What came of an attempt. Values are those of the lowest ``width_bits`` of the register.

    ``not_activated``: no instruction offered an eligible register. ``failed``: see ``reason``.
    """

    status: Literal["injected", "not_activated", "not_reached", "diverged", "failed"]
    reason: str = ""
    instruction: Instruction | None = None
    candidate: Candidate | None = None
    bit: int = 0
    before: int = 0
    after: int = 0
    read_back: int = 0
    passed_over: int = 0


class TargetError(Exception):
    """The target died or went wrong by itself, before the fault."""


def registers_of(thread: Thread) -> Registers:
    """The registers of a standing thread, by the architecture that we run on.

    :raises GoneError: if the thread has been killed.
    """
    return X8664Registers(thread.tid)


def stand(thread: Thread, process: Process) -> tuple[Registers, Instruction]:
    """Where a thread stands: its registers and the instruction that it executes next.

    :raises TargetError: if it has been killed, or there is no instruction.
    """
    try:
        registers = registers_of(thread)
        address = registers.program_counter
        return registers, decode(process.read_code(address), address)
    except (GoneError, CodeError, DecodeError) as error:
        raise TargetError(str(error)) from error


def step(tracees: Tracees, thread: Thread, instruction: Instruction) -> None:
    """Let a thread execute ``instruction``, at which it stands.

    :raises TargetError: if it does not come through it.
    """
    end = tracees.step(thread)
    if end == "faulted":
        message = f"{instruction.text} raised signal {thread.signals[-1]}"
        raise TargetError(message)
    if end != "stepped":
        what = "was killed in" if end == "gone" else "did not come back from"
        message = f"the thread {what} {instruction.text}"
        raise TargetError(message)


def strike(
    tracees: Tracees, thread: Thread, process: Process, fault: FaultSpec, draw: np.random.Generator
) -> Strike | None:
    """Flip one bit of a standing thread, at its next instruction that has an eligible register.

    The pair of register and role is drawn uniformly from those that are eligible, then the bit from
    those that the instruction accesses. A source is flipped before the instruction, a destination after
    it (after one iteration, if it repeats).

    None: the thread is in a system call or about to enter one (or to show the program that it is being
    stepped). That is no user instruction; the thread must run on first.
    """
    passed_over = 0
    try:
        while passed_over < SITES:
            registers, instruction = stand(thread, process)
            if registers.in_system_call or not instruction.steppable:
                return None
            eligible = instruction.eligible(fault.operand, fault.register_class)
            if eligible:
                candidate = eligible[int(draw.integers(len(eligible)))]
                bit = int(draw.integers(candidate.width_bits))
                if candidate.role == "destination":
                    step(tracees, thread, instruction)
                return replace(flip(thread, instruction, candidate, bit), passed_over=passed_over)
            step(tracees, thread, instruction)
            passed_over += 1
    except (TargetError, GoneError) as error:
        return Strike("failed", f"before the fault: {error}", passed_over=passed_over)
    reason = f"no eligible register in {SITES} consecutive instructions"
    return Strike("not_activated", reason, passed_over=passed_over)


def flip(thread: Thread, instruction: Instruction, candidate: Candidate, bit: int) -> Strike:
    """Flip one bit of a standing thread's register and read it back.

    :raises GoneError: if the thread has been killed.
    """
    accessed = (1 << candidate.width_bits) - 1
    registers = registers_of(thread)
    before = registers.get(candidate.register)
    after = before ^ 1 << bit
    registers.put(candidate.register, after)
    registers.commit()
    read_back = registers_of(thread).get(candidate.register)
    taken = read_back == after
    return Strike(
        "injected" if taken else "failed",
        "" if taken else f"the kernel did not take the change of {candidate.register}",
        instruction,
        candidate,
        bit,
        before & accessed,
        after & accessed,
        read_back & accessed,
    )
