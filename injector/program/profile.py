"""How often a program's run executes each instruction; those to strike are drawn from that."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from functools import cached_property

import numpy as np

from injector.block_profile.counted_call import BlockCounts
from injector.block_profile.instruction_counts import InstructionCounts, draw_instruction
from injector.faults.eligibility import is_eligible
from injector.isa.host import decode
from injector.isa.instruction import DecodeError
from injector.kernel_study.results import SamplePoint
from injector.program.countdown import JUMP_BYTES, SHORT_JUMP_BYTES, bytes_nearby, displaced
from injector.program.counted_program import CountedProgram
from injector.program.spec import ProgramSpec
from injector.tracing.elf import CodeLocations
from injector.tracing.process import MemoryMap
from injector.tracing.source_lines import SourceLineError, code_of_line
from injector.tracing.symbols import SymbolError, functions_named, module_code
from services.models.faults.specification import FaultSpec

FEW_PASSES = 100
"""Passes that are counted by a breakpoint of the processor: less than putting other code in place takes."""


class ScopeError(Exception):
    """The program executes no code of the scope that was asked for: one line."""


class ProgramProfile:
    """The counts of one run. ``counts`` are of all instructions, ``scope`` of those in the specified code."""

    def __init__(self, pid: int, counted: CountedProgram, blocks: BlockCounts, spec: ProgramSpec) -> None:
        """Sum up a run that has ended.

        :raises ScopeError: if it executed nothing of the specified code.
        """
        self._blocks, self._code = blocks, counted.translations.sources
        self._maps = counted.maps
        self._counted: dict[int, tuple[int, int]] = {}
        self._several_threads = counted.translations.threads > 1
        self.places = CodeLocations(pid, counted.maps)
        self.counts = InstructionCounts.of(blocks, order=self.places.named)
        self._holding: dict[int, list[int]] = defaultdict(list)
        for number, instructions in enumerate(blocks.instructions):
            for address in instructions:
                self._holding[address].append(number)
        self._passes = dict(zip(self.counts.addresses.tolist(), self.counts.passes.tolist(), strict=True))
        in_scope = _scope(pid, counted.maps, self.places, self._passes, spec)
        self.scope = self.counts.only(in_scope)
        if not self.scope.executed:
            raise ScopeError("the program executes no instruction of the code that was asked for")

    def eligible(self, fault: FaultSpec) -> InstructionCounts:
        """The counts of what a fault can strike in the specified code."""
        return self.scope.only(lambda address: self._is_eligible(fault, address))

    def draw(self, eligible: InstructionCounts, index: int, draw: np.random.Generator) -> SamplePoint | None:
        """Draw one of the eligible dynamic instructions, all alike; None if there is none."""
        drawn = draw_instruction(eligible, lambda _: True, draw)
        if drawn is None:
            return None
        by_breakpoint = drawn.hit <= FEW_PASSES and not self._several_threads
        at, way = (0, 0) if by_breakpoint else self._counted_at(drawn.address)
        return SamplePoint(index=index, address=drawn.address, hit=drawn.hit, counted_at=at, by_way_of=way)

    def _is_eligible(self, fault: FaultSpec, address: int) -> bool:
        try:
            return is_eligible(fault, decode(self._code_at(address)[:15], address))
        except DecodeError:
            return False

    def _code_at(self, address: int) -> bytes:
        number = self._holding[address][0]
        return self._code[number][address - self._blocks.instructions[number][0] :]

    @cached_property
    def _arrivals(self) -> frozenset[int]:
        return frozenset(one[0] for one in self._blocks.instructions)

    @cached_property
    def _executed(self) -> frozenset[int]:
        """The addresses of all bytes of instructions that were executed."""
        lasts = [block[-1] for block in self._blocks.instructions]
        ends = (one + len(decode(self._code_at(one)[:15], one).code) for one in lasts)
        blocks = zip(self._blocks.instructions, ends, strict=True)
        return frozenset(at for block, end in blocks for at in range(block[0], end))

    def _counted_at(self, address: int) -> tuple[int, int]:
        """Where passes through an address can be counted: a few instructions before, or there; 0 if nowhere.

        Straight code leads from there to the address, and nobody comes to the address in another way. The
        second is by way of which bytes the jump there leads, 0 if straight.
        """
        if address not in self._counted:
            straight = self._jumps(address, JUMP_BYTES, lambda _: 0)
            around = straight or [
                one for one in self._jumps(address, SHORT_JUMP_BYTES, self._unused_bytes) if one[-1]
            ]
            self._counted[address] = min(around)[-2:] if around else (0, 0)
        return self._counted[address]

    def _jumps(
        self, address: int, size: int, way_of: Callable[[int], int]
    ) -> list[tuple[bool, int, int, int]]:
        """Jumps that can be put where an address is passed: by rank, where, and by way of which bytes."""
        found = []
        for number in self._holding[address]:
            instructions = self._blocks.instructions[number]
            before = instructions[: instructions.index(address) + 1]
            for distance, one in enumerate(reversed(before)):
                if self._passes[one] != self._passes[address]:
                    break
                taken = displaced(self._code_at(one), one, self._arrivals, size)
                if taken is not None:
                    found.append((not taken.flags_are_free, distance, one, way_of(one)))
        return found

    def _unused_bytes(self, address: int) -> int:
        """Where near an address a jump can lie, in code that the run does not execute; 0 if nowhere.

        Of several threads another run may execute other code.
        """
        piece = self._maps.at(address)
        if piece is None or self._several_threads:
            return 0
        start, end = piece.start, piece.end
        return bytes_nearby(address, lambda at: start <= at < end and at not in self._executed)


def _scope(
    pid: int, maps: MemoryMap, places: CodeLocations, passes: dict[int, int], spec: ProgramSpec
) -> Callable[[int], bool]:
    """A test of addresses: whether they are of the code that is specified."""
    if spec.line:
        return _line(pid, maps, places, passes, spec)
    if spec.symbol:
        return _functions(pid, maps, places, passes, spec)
    if not spec.module:
        return lambda _: True
    try:
        pieces = module_code(maps, spec.module)
    except SymbolError as error:
        raise ScopeError(str(error)) from error
    inside: Callable[[int], bool] = lambda one: any(piece.start <= one < piece.end for piece in pieces)  # noqa: E731
    if spec.address is None:
        return inside
    return lambda one: inside(one) and places.named(one)[2] == spec.address


def _functions(
    pid: int, maps: MemoryMap, places: CodeLocations, passes: dict[int, int], spec: ProgramSpec
) -> Callable[[int], bool]:
    """Of functions of that name those that run: several modules may define one."""
    try:
        named = functions_named(pid, maps, spec.symbol, spec.module)
    except SymbolError as error:
        raise ScopeError(str(error)) from error
    run = {address: symbol for address, symbol in named.items() if address in passes}
    inside: set[int] = set()
    addresses = sorted(passes)
    for begin, symbol in run.items():
        for address in addresses[np.searchsorted(addresses, begin) :]:
            if places.at(address).symbol != symbol:
                break
            inside.add(address)
    return inside.__contains__


def _line(
    pid: int, maps: MemoryMap, places: CodeLocations, passes: dict[int, int], spec: ProgramSpec
) -> Callable[[int], bool]:
    """Of a source line's code what the rest of the specification leaves of it."""
    try:
        code = code_of_line(pid, maps, spec.line, spec.module)
    except (SourceLineError, SymbolError) as error:
        raise ScopeError(str(error)) from error
    rest = _scope(pid, maps, places, passes, spec.model_copy(update={"line": ""}))
    return lambda one: any(begin <= one < end for begin, end in code) and rest(one)
