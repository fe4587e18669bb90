"""Functions that numba has compiled: code in no file, told by the function's name and the place in it.

Where such code lies depends on the installation, down to the length of its path; what it is called does not,
for the code of an installation is compiled as a whole (:mod:`injector.reproducible.compiled_code`).
"""

from __future__ import annotations

import hashlib
import re
from bisect import bisect_right
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from numba.core.registry import cpu_target

from injector.tracing.process import MemoryMap

_WORD = re.compile(r"(\d+)(\w+)")
_ADDRESS = re.compile(r"_0x[0-9a-f]+")
"""Where the compiler had an array expression in memory; such names have a number of their own, too."""
_LOCAL = re.compile(r"_3c(\w+?)_3e")


class CompiledFunction(NamedTuple):
    """A function that numba has compiled: its address, and its name as the linker knows it."""

    start: int
    name: str

    @property
    def module(self) -> str:
        """What stands for the name of a file where such a function is told."""
        return "numba"

    @property
    def identity(self) -> str:
        """What tells functions apart, alike in each installation: a hash of the name, hexadecimal."""
        return hashlib.blake2b(_ADDRESS.sub("", self.name).encode(), digest_size=20).hexdigest()

    @property
    def symbol(self) -> str:
        """The name as a person writes it: ``services.control.pid.pid``.

        Names are as in the Itanium C++ ABI, parts with their lengths in front; what follows tells types.
        """
        prefix, _, rest = self.name.partition("_ZN")
        parts = []
        while found := _WORD.match(rest):
            length, text = int(found[1]), found[2]
            parts.append(text[:length])
            rest = rest[len(found[1]) + length :]
        return prefix + _LOCAL.sub(r"<\1>", ".".join(parts)) if parts else self.name


class CompiledFunctions:
    """The functions that numba has compiled in this process, and so in every fork of it or of its parent.

    What was compiled, or mapped, after the processes parted is none of them.
    """

    def __init__(self) -> None:
        # numba tells nowhere else where it has put what.
        engine = cpu_target.target_context.codegen()._engine
        addresses = ((engine._ee.get_function_address(name), name) for name in engine._defined_symbols)
        maps = MemoryMap(Path("/proc/self/maps").read_text())
        self._pieces = [(one.start, one.end) for one in maps.code() if not one.name]
        self._functions = sorted(
            CompiledFunction(start, name) for start, name in addresses if self._piece(start) is not None
        )
        self._identified = {(one.module, one.identity): one for one in self._functions}

    def at(self, address: int) -> CompiledFunction | None:
        """The function that an address lies in."""
        index = bisect_right(self._functions, address, key=lambda one: one.start) - 1
        if index < 0:
            return None
        found = self._functions[index]
        return found if self._piece(found.start) == self._piece(address) is not None else None

    def identified(self, module: str, identity: str) -> CompiledFunction | None:
        """The function of that identity, if it is one of these."""
        return self._identified.get((module, identity))

    def _piece(self, address: int) -> tuple[int, int] | None:
        index = bisect_right(self._pieces, address, key=lambda one: one[0]) - 1
        return self._pieces[index] if index >= 0 and address < self._pieces[index][1] else None


@lru_cache(1)
def compiled_functions() -> CompiledFunctions:
    """The functions that were compiled before this was first asked: what nodes run was, before they began."""
    return CompiledFunctions()
