"""Base of the approaches to an injection point: errors become results, system calls are passed over."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar, Literal

import numpy as np

from injector.faults.stopped_thread import InjectionResult, TargetError, stand
from injector.tracing.process import AddressError, Process
from injector.tracing.ptrace import GoneError
from injector.tracing.tracee import Tracee

JITTER_STEPS = 64
"""Most single steps after the trap: a trap comes at an interrupt, and not at every instruction alike."""

SYSTEM_CALLS = 16
"""System calls met at the drawn moment that are let pass before we give up."""


class MissedError(Exception):
    """The fault cannot be injected as it was asked for."""

    def __init__(
        self, status: Literal["not_activated", "not_reached", "diverged", "failed"], reason: str
    ) -> None:
        super().__init__(reason)
        self.result = InjectionResult(status, reason)


class Approach(ABC):
    """Brings a thread of the target to one injection point, and injects.

    ``draw`` is the generator of everything that is drawn until then.
    """

    DIED: ClassVar[str]
    """The reason in the result if the target dies before the fault."""

    draw: np.random.Generator

    def run(self) -> InjectionResult:
        """Reach the injection point and inject; a fault that could not be injected is a result as well."""
        try:
            return self._run()
        except MissedError as error:
            return error.result
        except (GoneError, AddressError):
            return InjectionResult("failed", self.DIED)
        except TargetError as error:
            return InjectionResult("failed", f"before the fault: {error}")

    @abstractmethod
    def _run(self) -> InjectionResult:
        """Reach the injection point and inject the fault.

        :raises MissedError: if the fault cannot be injected as it was asked for.
        """

    def _past_system_calls(self, attempt: Callable[[int], InjectionResult | None]) -> InjectionResult:
        """Attempt the injection until it does not meet a system call; those met are counted in the result.

        ``attempt`` is told how many it has met; it answers None if it has met another one.
        """
        for met in range(SYSTEM_CALLS):
            found = attempt(met)
            if found is not None:
                return replace(found, passed_over=found.passed_over + met)
        return InjectionResult(
            "not_activated", f"met {SYSTEM_CALLS} system calls in a row", passed_over=SYSTEM_CALLS
        )

    def _jitter(
        self,
        thread: Tracee,
        process: Process,
        step: Callable[[Tracee], object],
        check: Callable[[], None] = lambda: None,
    ) -> None:
        """Step on by a drawn number of instructions, but into no system call; ``check`` before each."""
        for _ in range(int(self.draw.integers(JITTER_STEPS + 1))):
            check()
            registers, instruction = stand(thread, process)
            if registers.in_system_call or not instruction.steppable:
                return
            step(thread)
        check()
