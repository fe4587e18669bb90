"""One function per fault model that corrupts one instruction; None if nothing of it is eligible."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from injector.faults.eligibility import eligible_memory, eligible_registers
from injector.faults.opcode import corrupt, execute
from injector.faults.stopped_thread import (
    InjectionResult,
    StoppedThread,
    TargetError,
    registers_of,
    stand,
    step,
)
from injector.isa.instruction import Candidate, MemoryAccess
from injector.isa.registers import Registers
from injector.tracing.ptrace import GoneError
from services.models.faults.arithmetic import draw_bits, struck
from services.models.faults.specification import FaultSpec


def corrupt_register(
    at: StoppedThread, fault: FaultSpec, draw: np.random.Generator
) -> InjectionResult | None:
    """Change a register that the instruction reads or writes, once or for some time."""
    eligible = eligible_registers(fault, at.instruction)
    if not eligible:
        return None
    candidate, among = eligible[int(draw.integers(len(eligible)))]
    bits = draw_bits(fault, among, draw)
    # A thread that stands keeps its registers: what becomes of them is worked out while the others still run.
    change = RegisterChange(at.registers, fault, candidate, bits)
    at.stop()
    if candidate.role == "destination":
        at.execute()
        change = RegisterChange(registers_of(at.thread), fault, candidate, bits)
    read_back = change.make(at)
    if fault.model == "stuck_at":
        return _hold(at, fault, candidate, change.told(at, read_back))
    at.go()
    return change.told(at, read_back)


class RegisterChange:
    """Bits of one register that are to be changed in a standing thread."""

    def __init__(
        self, registers: Registers, fault: FaultSpec, candidate: Candidate, bits: tuple[int, ...]
    ) -> None:
        self._fault, self._candidate, self._bits = fault, candidate, bits
        self._registers = registers
        self._before = registers.get(candidate.register)
        self._after = struck(fault, self._before, bits)
        registers.put(candidate.register, self._after)

    def make(self, at: StoppedThread) -> int:
        """Write the change to the thread and return what is read back.

        :raises GoneError: if the thread has been killed.
        """
        self._registers.commit()
        return registers_of(at.thread).get(self._candidate.register)

    def told(self, at: StoppedThread, read_back: int) -> InjectionResult:
        """The result: what was changed, and whether it was read back."""
        candidate = self._candidate
        accessed = (1 << candidate.width_bits) - 1
        return _judged(
            self._fault,
            f"the kernel did not take the change of {candidate.register}",
            InjectionResult(
                "injected",
                instruction=at.instruction,
                operand=candidate.role if self._fault.registers is None else "",
                register=candidate.register,
                width_bits=candidate.width_bits,
                element_bits=candidate.element_bits,
                bits=self._bits,
                before=self._before & accessed,
                after=self._after & accessed,
                read_back=read_back & accessed,
            ),
        )


def _judged(fault: FaultSpec, refused: str, found: InjectionResult) -> InjectionResult:
    """The status by what was read back; ``refused`` is the reason if that is not what was written."""
    if found.read_back != found.after:
        return replace(found, status="failed", reason=refused)
    if fault.model == "none":
        return replace(found, status="not_activated", reason="model none: all was done but the flip")
    return found


def _hold(
    at: StoppedThread, fault: FaultSpec, candidate: Candidate, first: InjectionResult
) -> InjectionResult:
    """Hold the bits for as many instructions as asked for: force them before each of them.

    It ends earlier, with a reason, where the thread can be stepped no further.
    """
    wanted = fault.stuck_instructions or 1
    changed, held, reason = first.before != first.after, 1, ""
    while first.status == "injected" and held < wanted and not reason:
        try:
            registers, instruction = stand(at.thread, at.process)
            if registers.in_system_call or not instruction.steppable:
                reason = f"held until {instruction.text}"
                break
            step(at.tracees, at.thread, instruction)
            change = RegisterChange(registers_of(at.thread), fault, candidate, first.bits)
            again = change.told(at, change.make(at))
        except (TargetError, GoneError) as error:
            reason = f"held until the thread stopped short: {error}"
            break
        changed = changed or again.before != again.after
        reason = again.reason
        held += 1
    if first.status == "injected" and not changed:
        reason = f"the bits were {fault.stuck_value} already in all {held} instructions"
        return replace(first, status="not_activated", reason=reason, held_instructions=held)
    return replace(first, reason=reason or first.reason, held_instructions=held)


def corrupt_memory(at: StoppedThread, fault: FaultSpec, draw: np.random.Generator) -> InjectionResult | None:
    """Change memory that the instruction reads or writes.

    :raises AddressError: if it is not there or cannot be written.
    """
    eligible = eligible_memory(fault, at.instruction)
    if not eligible:
        return None
    access, among = eligible[int(draw.integers(len(eligible)))]
    bits = draw_bits(fault, among, draw)
    address = address_of(access, at.registers)
    at.stop()
    if access.role == "destination":
        at.execute()
    size = access.width_bits // 8
    before = int.from_bytes(at.process.read_memory(address, size), "little")
    after = struck(fault, before, bits)
    at.process.write_memory(address, after.to_bytes(size, "little"))
    read_back = int.from_bytes(at.process.read_memory(address, size), "little")
    found = InjectionResult(
        "injected",
        instruction=at.instruction,
        operand=access.role,
        address=address,
        width_bits=access.width_bits,
        element_bits=access.element_bits,
        bits=bits,
        before=before,
        after=after,
        read_back=read_back,
    )
    return _judged(fault, f"the memory at {address:#x} did not take the change", found)


def address_of(access: MemoryAccess, registers: Registers) -> int:
    """The address of the memory that an instruction is about to access."""
    address = access.displacement
    if access.base:
        address += registers.get(access.base)
    if access.index:
        address += registers.get(access.index) * access.scale
    address %= 1 << access.address_bits
    return (address + registers.get(access.segment)) % 2**64 if access.segment else address


def corrupt_opcode(at: StoppedThread, fault: FaultSpec, draw: np.random.Generator) -> InjectionResult | None:
    """Have another instruction executed in its place, once.

    :raises AddressError: if its bytes cannot be changed, or not be restored.
    """
    at.stop()  # the bytes that are put back are those that are read now
    corrupted = corrupt(at.instruction, at.process, fault, draw)
    if corrupted is None:
        return None
    read_back, reason = execute(at.tracees, at.thread, at.process, at.instruction, corrupted)
    found = InjectionResult(
        "injected",
        reason,
        at.instruction,
        address=at.instruction.address,
        width_bits=8 * len(corrupted.code),
        bits=corrupted.bits,
        before=int.from_bytes(at.instruction.code, "little"),
        after=int.from_bytes(corrupted.code, "little"),
        read_back=int.from_bytes(read_back, "little"),
        instruction_after=corrupted.text,
    )
    return _judged(fault, "the code did not take the change", found)


Corruption = Callable[[StoppedThread, FaultSpec, np.random.Generator], InjectionResult | None]

CORRUPTIONS: dict[str, Corruption] = {
    "bitflip": corrupt_register,
    "stuck_at": corrupt_register,
    "none": corrupt_register,
    "opcode": corrupt_opcode,
    "memory": corrupt_memory,
}
