"""A kernel's own code in translation, for as long as its node lives, with what leads to strikes built in."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import iced_x86
from iced_x86 import FlowControl

from injector.block_profile.translated_code import TranslatedCode
from injector.block_profile.translation_memory import TranslationMemory, TranslationMemoryError
from injector.block_profile.x86_64_translator import (
    TRAP,
    InsertedCode,
    Translation,
    TranslationError,
    translate,
)
from injector.faults.eligibility import eligible_registers, is_eligible
from injector.isa.host import decode
from injector.isa.instruction import Candidate, DecodeError, Instruction
from injector.isa.x86_64_decoder import first_input, mnemonic
from injector.isa.x86_64_registers import register_classes
from injector.recurrence.schedule import draws_of_defect
from injector.recurrence.strike_code import OFF, ControlWords, CountdownCode, DefectCode, InputPattern
from injector.recurrence.unwinding import TrappedUnwinder
from injector.tracing import ptrace
from injector.tracing.process import Process
from injector.tracing.tracee import Tracee
from services.models.faults.arithmetic import draw_bits, struck
from services.models.faults.specification import FaultSpec

FAR = 1 << 62
"""A count of executions to which no call comes."""

_WORD = struct.Struct("<Q")
_NO_INSTRUCTION = b"\x0f\x0b"  # ud2 raises SIGILL


@dataclass(frozen=True, slots=True)
class StrikePlace:
    """What is struck at a trap: an ``instruction``, and of a defect the ``operand`` and its ``bits``."""

    instruction: Instruction
    inserted: CountdownCode | DefectCode
    operand: Candidate | None = None
    bits: tuple[int, ...] = ()


class StruckCode(TranslatedCode):
    """The code of one process in which a fault recurs; ``words`` say what happens in it."""

    def __init__(
        self,
        thread: Tracee,
        process: Process,
        code: Sequence[tuple[int, int]],
        fault: FaultSpec,
        seed: int,
    ) -> None:
        """Have ``code``, ranges in order, run in translation from now on; nothing strikes yet.

        :raises TranslationMemoryError: if there is no room near enough to all of it.
        """
        super().__init__(thread, process, code)
        if len(self._memories) != 1:
            message = f"the kernel's own code lies in {len(self._memories)} places too far from one another"
            raise TranslationMemoryError(message)
        self._fault, self._seed = fault, seed
        self._wide = "mask" in register_classes()
        self._places: dict[int, StrikePlace] = {}
        self._new: list[StrikePlace] = []
        self._copy: Process | None = None
        self._returns: dict[int, int] = {}
        self.words = ControlWords.in_memory(self._memories[0])
        self.disarm()
        self.overwrite()
        self._unwinder = TrappedUnwinder(process)

    # -- what happens in it ------------------------------------------------------------------------

    def disarm(self) -> None:
        """Have the code run without strikes until it is armed again."""
        self.put(self.words.mode, OFF)
        self.put(self.words.left, FAR)

    def put(self, word: int, value: int) -> None:
        """Change one of the words by which code and injector know of each other."""
        self._process.write_memory(word, _WORD.pack(value))

    def get(self, word: int, process: Process | None = None) -> int:
        """One of the words, of a copy of the process if one is given."""
        (value,) = _WORD.unpack((process or self._process).read_memory(word, _WORD.size))
        return int(value)

    def place_at(self, address: int) -> StrikePlace | None:
        """What is to be struck by who stands behind a trap."""
        return self._places.get(address)

    def lead_on(self, tid: int, copy: Process | None = None) -> bool:
        """Lead on a thread that stands behind a trap; False if that is none of ours.

        What is translated for a ``copy`` of the process, the process has, too.
        """
        trap = ptrace.program_counter(tid) - len(TRAP)
        if self._unwinder.is_entered(trap):
            self._unwinder.enter(tid, copy or self._process, trap, self._returns)
            return True
        self._copy = copy
        try:
            return self._lead_on(tid)
        finally:
            self._copy = None

    def _write(self, address: int, content: bytes) -> None:
        super()._write(address, content)
        if self._copy is not None:
            self._copy.write_memory(address, content)

    # -- what is built in --------------------------------------------------------------------------

    def _make(self, address: int, memory: TranslationMemory) -> Translation:
        try:
            made = translate(self._block_at(address), address, memory.here, None, insert=self._insert)
        except TranslationError:
            # Who came here, led by a strike, is to fare as without us.
            made = Translation(
                (address,), len(_NO_INSTRUCTION), _NO_INSTRUCTION, (), (), 0, takes_a_jump=False
            )
        self._places |= {one.inserted.trapped_at: one for one in self._new}
        self._new.clear()
        self._returns |= dict(made.returns)
        return made

    def _insert(self, one: iced_x86.Instruction, code: bytes) -> InsertedCode | None:
        fault = self._fault
        if fault.opcodes is not None and mnemonic(one) not in fault.opcodes:
            return None
        try:
            instruction = decode(code, one.ip)
        except DecodeError:
            return None
        if not is_eligible(fault, instruction):
            return None
        place = (
            self._defect(instruction, one)
            if fault.recurrence == "permanent"
            else StrikePlace(instruction, CountdownCode(self.words))
        )
        if place is None:
            return None
        self._new.append(place)
        return place.inserted

    def _defect(self, instruction: Instruction, decoded: iced_x86.Instruction) -> StrikePlace | None:
        """The operand of an instruction that a defective unit spoils: a destination, if not a source."""
        flows = decoded.flow_control == FlowControl.NEXT
        role = "source" if self._fault.operand == "source" else "destination"
        eligible = [one for one in eligible_registers(self._fault, instruction) if one[0].role == role]
        if not eligible or (role == "destination" and not flows):
            return None
        pattern = self._pattern(decoded)
        if pattern is None and self._fault.operand_pattern is not None:
            return None
        of_operand, of_bits = draws_of_defect(self._fault, self._seed)
        operand, among = eligible[int(of_operand.integers(len(eligible)))]
        bits = draw_bits(self._fault, among, of_bits)
        mask = struck(self._fault, 0, bits)
        code = DefectCode(self.words, operand, mask, pattern, wide=self._wide)
        return StrikePlace(instruction, code, operand, bits)

    def _pattern(self, decoded: iced_x86.Instruction) -> InputPattern | None:
        """What the fault asks of the instruction's input; None if nothing, or it has not all those bits."""
        asked, read = self._fault.operand_pattern, first_input(decoded)
        if asked is None or read is None or asked[0] >> read.width_bits:
            return None
        return InputPattern(read, *asked)
