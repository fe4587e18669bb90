"""A motor that fails: the thrust that it is asked for instead of the flight controller's."""

from __future__ import annotations

from math import inf

import numpy as np
from numpy.typing import NDArray

from services.models.faults.specification import MOTORS, FaultSpec
from services.models.outcome import InjectionRecord
from services.runtime.rng import generator

Floats = NDArray[np.float64]

_BLOCK = 256


class MotorFault:
    """One motor that fails between two times.

    ``off``: no thrust. ``stuck``: the last before. ``garbage``: drawn anew in each period of the flight
    controller. ``wrong``: multiplied by ``size``. ``slow``: a new value each ``size`` s. ``delayed``: what
    was asked for ``size`` s ago. ``intermittent``: none, with a probability, in each period alone. All within
    what the motor can do. ``records`` are those of the periods in which it was changed, until they are taken.
    """

    def __init__(self, fault: FaultSpec, mission_seed: int, max_thrust_n: float, period_s: float) -> None:
        self._fault = fault
        self._seed = mission_seed
        self._motor = MOTORS.index(fault.target)
        self._most_n = max_thrust_n
        self._period_s = period_s
        self._until_s = inf if fault.until_s is None else fault.until_s
        self._held_n: float | None = None
        self._held_step = 0
        self._past: list[float] = []
        self._block, self._draws = -1, np.empty(0)
        self.records: list[InjectionRecord] = []

    def strike(self, step: int, thrust: Floats) -> None:
        """Change ``thrust`` (4,), newtons, in the period that begins with physics step ``step``."""
        asked_n = float(thrust[self._motor])
        if self._fault.model == "delayed":
            self._past.append(asked_n)
        if not self._fault.from_s <= step * self._period_s < self._until_s:
            self._held_n, self._held_step = asked_n, step
            return
        given_n = min(max(self._instead(step, asked_n), 0.0), self._most_n)
        if given_n == asked_n:
            return
        thrust[self._motor] = given_n
        self.records.append(
            InjectionRecord(
                status="injected",
                precision="exact",
                node="sim",
                kernel="",
                invocation=step,
                state=[self._fault.target],
                model=self._fault.model,
                virtual_time_ns=round(step * self._period_s * 1e9),
                before=f"{asked_n:.6g} N",
                after=f"{given_n:.6g} N",
                read_back=f"{float(thrust[self._motor]):.6g} N",
                trigger=self._fault.trigger,
            )
        )

    def _instead(self, step: int, asked_n: float) -> float:
        fault, size = self._fault, self._fault.size or 0.0
        if fault.model in ("stuck", "slow"):
            renewed = fault.model == "slow" and (step - self._held_step) * self._period_s >= size
            if self._held_n is None or renewed:
                self._held_n, self._held_step = asked_n, step
            return self._held_n
        if fault.model == "delayed":
            return self._past[max(len(self._past) - 1 - round(size / self._period_s), 0)]
        if fault.model == "garbage":
            return self._drawn(step) * self._most_n
        if fault.model == "intermittent":
            size = float(self._drawn(step) >= (fault.probability or 0.0))
        return asked_n * size

    def _drawn(self, step: int) -> float:
        """A number from 0 to 1 for each step, the same in every repetition."""
        block, place = divmod(step, _BLOCK)
        if block != self._block:
            draw = generator(self._seed, f"actuator {self._fault.target}", self._fault.seed, block)
            self._block, self._draws = block, draw.random(_BLOCK)
        return float(self._draws[place])
