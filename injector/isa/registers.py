"""What the injector asks of a register file, whatever the architecture.

:mod:`injector.isa.x86_64_registers` and :mod:`injector.isa.aarch64_registers` implement it;
:mod:`injector.isa.host` chooses.
"""

from __future__ import annotations

from abc import ABC, abstractmethod


class Registers(ABC):
    """The user registers of a standing thread: a copy, which :meth:`commit` writes back.

    Registers go by the names that disassembly shows (``rax``, ``eax``, ``ah``, ``ymm3``). Values are
    unsigned; bit 0 is the least significant bit of the named register. Status flags are bits of one
    register (``rflags``, ``nzcv``), whose other bits read as zero and cannot be changed.
    """

    @property
    @abstractmethod
    def program_counter(self) -> int:
        """Address of the instruction that comes next."""

    @property
    @abstractmethod
    def stack_pointer(self) -> int:
        """Address of the top of the thread's stack."""

    @property
    @abstractmethod
    def in_system_call(self) -> bool:
        """Whether the thread was stopped within a system call that is to be entered again."""

    @abstractmethod
    def get(self, name: str) -> int:
        """The value of a register, by its name.

        :raises UnknownRegisterError: if this machine has none of that name.
        """

    @abstractmethod
    def put(self, name: str, value: int) -> None:
        """Change a register and nothing else: writing ``eax`` keeps the upper half of ``rax``.

        :raises UnknownRegisterError: if this machine has none of that name.
        """

    @abstractmethod
    def commit(self) -> None:
        """Write the changes to the thread."""


class UnknownRegisterError(Exception):
    """There is no register of that name here, or the kernel does not show it to tracers."""
