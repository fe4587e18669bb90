"""What a worker that strikes a kernel or a program again and again is asked for, and what it answers."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from services.models.base import Strict
from services.models.faults.specification import FaultSpec
from services.models.outcome import InjectionRecord

StudyResult = Literal["benign", "sdc", "crash", "detected", "hang", "not_injected"]

Pass = tuple[int, int]
"""An address, and the number of a pass through it."""


class SamplePoint(Strict):
    """The ``index``-th drawn instruction: the ``hit``-th pass through an address.

    In a program's run passes are counted where the instruction at ``counted_at`` is, a few before; 0: at the
    address itself, by a breakpoint. The jump there leads by way of unused bytes at ``by_way_of``, unless 0.
    """

    index: int
    address: int
    hit: int
    counted_at: int = 0
    by_way_of: int = 0

    @property
    def at(self) -> Pass:
        """The address, and the number of the pass through it."""
        return self.address, self.hit


class StudyRun(Strict):
    """One injection into a kernel alone, or into a run of a program.

    ``sdc``: the output differs in a bit; ``within_tolerance`` says whether by no more than matters, and
    ``deviation`` by how much in the kernel's unit (None: it has more or fewer values, or not all are
    numbers). A program's run within its tolerance is benign. ``detected``: the program ended with an exit
    status by which it says that it noticed. ``cause``: of a crash, the signal or "exception"; of a program's
    run, what differs. Pid, tid and pause of the record are 0, as they tell nothing of a copy; the rest is the
    same in every run.
    """

    kernel: str
    index: int
    result: StudyResult
    within_tolerance: bool = False
    deviation: float | None = None
    cause: str = ""
    point: SamplePoint | None = Field(default=None, description="of a program's run: the drawn instruction")
    injection: InjectionRecord


class CallLength(Strict):
    """How many instructions a call executes: in the fault's scope, of these such as it can strike, and all.

    ``all`` is not known of a call that can be counted in the scope only.
    """

    scope: int
    eligible: int
    all: int | None = None


class StudyTask(Strict):
    """What a worker is asked for: to draw injections by their numbers, or to make those of a leg."""

    fault: FaultSpec
    seed: int
    draw: tuple[int, ...] = ()
    leg: tuple[SamplePoint, ...] = ()


class StudyAnswer(Strict):
    """One line of a worker: what was drawn, in the order of the call; what came of a place; our own problem.

    ``refused``: a program cannot be struck as it is, and why.

    The last one to a task has the processor time that worker and copies have used so far.
    """

    length: CallLength | None = None
    drawn: tuple[SamplePoint, ...] = ()
    run: StudyRun | None = None
    problem: str = ""
    refused: str = ""
    cpu_s: float | None = None
