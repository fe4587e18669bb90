"""A stopped thread with its registers and next instruction, and the result of an attempt to corrupt it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from injector.isa.host import HOST, decode
from injector.isa.instruction import DecodeError, Instruction, Role
from injector.isa.registers import Registers
from injector.tracing.process import CodeError, Process
from injector.tracing.ptrace import GoneError
from injector.tracing.tracee import Tracee
from injector.tracing.tracees import TraceeGroup


@dataclass(frozen=True, slots=True)
class InjectionResult:
    """What came of an attempt to inject. Values and ``bits`` are those of the corrupted ``width_bits``.

    ``register`` is empty where memory (at ``address``) or the instruction itself was corrupted.
    ``not_activated``: nothing was changed. ``failed``: see ``reason``, which also tells where an injected
    fault was cut short.
    """

    status: Literal["injected", "not_activated", "not_reached", "diverged", "failed"]
    reason: str = ""
    instruction: Instruction | None = None
    operand: Role | Literal[""] = ""
    register: str = ""
    address: int = 0
    width_bits: int = 0
    element_bits: int = 0
    bits: tuple[int, ...] = ()
    before: int = 0
    after: int = 0
    read_back: int = 0
    instruction_after: str = ""
    held_instructions: int = 0
    passed_over: int = 0


class TargetError(Exception):
    """The target died or went wrong by itself, before the fault."""


@dataclass(frozen=True, slots=True)
class StoppedThread:
    """A thread that stands before an instruction; the others run until ``stop`` is called, if not stopped.

    ``go`` may be called once all has been done to them, before it is told what: everybody goes on then.
    """

    tracees: TraceeGroup = field(repr=False)
    thread: Tracee
    process: Process = field(repr=False)
    registers: Registers
    instruction: Instruction
    stop: Callable[[], object] = field(repr=False)
    go: Callable[[], object] = field(repr=False)

    def execute(self) -> None:
        """Let the thread execute the instruction at which it stands.

        :raises TargetError: if it does not come through.
        """
        step(self.tracees, self.thread, self.instruction)


def registers_of(thread: Tracee) -> Registers:
    """The registers of a standing thread, by the architecture that we run on.

    :raises GoneError: if the thread has been killed.
    """
    return HOST.registers(thread.tid)


def stand(thread: Tracee, process: Process) -> tuple[Registers, Instruction]:
    """Where a thread stands: its registers and the instruction that it executes next.

    :raises TargetError: if it has been killed, or there is no instruction.
    """
    try:
        registers = registers_of(thread)
        address = registers.program_counter
        return registers, decode(process.read_code(address), address)
    except (GoneError, CodeError, DecodeError) as error:
        raise TargetError(str(error)) from error


def step(tracees: TraceeGroup, thread: Tracee, instruction: Instruction) -> None:
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
