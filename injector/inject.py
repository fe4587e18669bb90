"""Where a thread stands, what it executes next, and what comes of an attempt to corrupt it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

from injector.architecture import HOST, decode
from injector.decode import DecodeError, Instruction, Role
from injector.freeze import Tracees
from injector.process import CodeError, Process
from injector.ptrace import GoneError
from injector.registers import Registers
from injector.thread import Thread


@dataclass(frozen=True, slots=True)
class Strike:
    """What came of an attempt. Values and ``bits`` are those of the ``width_bits`` that were struck.

    ``register`` is empty where memory (at ``address``) or the instruction itself was struck.
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

    def described(self) -> dict[str, Any]:
        """The fields of an :class:`services.bus.outcome.InjectionRecord` that tell what was struck."""
        told: dict[str, Any] = {"status": self.status, "reason": self.reason, "resampled": self.passed_over}
        if self.instruction is not None:
            told |= {"instruction_bytes": self.instruction.code.hex(), "instruction": self.instruction.text}
        if not self.bits:
            return told
        for name in ("operand", "address", "width_bits", "element_bits"):
            told[name] = getattr(self, name)
        told |= {"register_name": self.register, "bits": list(self.bits)}
        told |= {"instruction_after": self.instruction_after, "held_instructions": self.held_instructions}
        digits = -(-self.width_bits // 4)
        return told | {name: f"{getattr(self, name):0{digits}x}" for name in ("before", "after", "read_back")}


class TargetError(Exception):
    """The target died or went wrong by itself, before the fault."""


@dataclass(frozen=True, slots=True)
class Standing:
    """A thread that stands before an instruction; the others run until ``stop`` is called, if not stopped.

    ``go`` may be called once all has been done to them, before it is told what: everybody goes on then.
    """

    tracees: Tracees = field(repr=False)
    thread: Thread
    process: Process = field(repr=False)
    registers: Registers
    instruction: Instruction
    stop: Callable[[], object] = field(repr=False)
    go: Callable[[], object] = field(repr=False)

    def execute(self) -> None:
        """Let the thread execute it.

        :raises TargetError: if it does not come through.
        """
        step(self.tracees, self.thread, self.instruction)


def registers_of(thread: Thread) -> Registers:
    """The registers of a standing thread, by the architecture that we run on.

    :raises GoneError: if the thread has been killed.
    """
    return HOST.registers(thread.tid)


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
