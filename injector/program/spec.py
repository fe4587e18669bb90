"""A program to be struck: how it is run, which of its code comes into question and what its output is."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from services.models.base import Strict

STREAMS = ("stdout", "stderr")
"""The files of a run in which standard output and error are."""


class ProgramSpec(Strict):
    """A program's command, its surroundings, the code to strike and what is compared of a run.

    With ``inputs`` or ``compare`` each run has a folder of its own, with copies of the inputs; otherwise it
    runs in ``folder``. ``environment`` is all that it has. Exit statuses ``detected`` say that the program
    noticed an error itself. ``module``, ``symbol`` and ``address`` (an offset as objdump shows it) narrow the
    code to a file, a function or one instruction, ``line`` (``FILE:LINE``) to what debug information says is
    of that line of the source. A ``comparator`` is given two folders, of a run without a
    fault and of one with: it ends with status 0 if their outputs count as the same, with 1 if not.
    """

    command: tuple[str, ...] = Field(min_length=1)
    executable: str = Field(default="", description="if it is not what the command's first word names")
    folder: str = ""
    environment: dict[str, str] = Field(default_factory=dict)
    stdin: str = "/dev/null"
    inputs: tuple[str, ...] = ()
    compare: tuple[str, ...] = Field(default=(), description="files that it writes: part of its output")
    ignore: tuple[Literal["stdout", "stderr"], ...] = Field(default=(), description="not compared")
    status: int = Field(default=0, description="exit status without a fault")
    detected: tuple[int, ...] = ()
    tolerance: float | None = Field(default=None, ge=0, description="relative, of numbers in text")
    comparator: tuple[str, ...] = ()
    module: str = ""
    symbol: str = ""
    address: int | None = None
    line: str = ""

    @property
    def name(self) -> str:
        """The program's name, without the folder that it lies in."""
        return self.command[0].rpartition("/")[2]

    @property
    def compared(self) -> tuple[str, ...]:
        """The files of a run that are compared."""
        return tuple(one for one in (*STREAMS, *self.compare) if one not in self.ignore)

    @property
    def has_own_folder(self) -> bool:
        """Whether each run has a folder of its own."""
        return bool(self.inputs or self.compare)


class ProgramOrder(Strict):
    """What a worker is told first: the program, the longest run without a fault, and where to write."""

    program: ProgramSpec
    limit_s: float
    scratch: str
