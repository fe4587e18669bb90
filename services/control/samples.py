"""Control's kernel on one tick of a flight: in a turn, with a controller that has been at work."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from services.bus.arrays import plan, state, verdict
from services.bus.messages import TwistStamped
from services.bus.topics import TICK_NS
from services.control.following import follower
from services.control.pid import REPORT_SIZE, pid, tuning
from services.models.mission import MissionSpec
from services.models.pilots import ALL_GUARDS, PILOTS
from services.runtime.kernel_trial import KernelTrial, NoSampleError, Sample, SampleFlight, cdr, decoded

_AT_SPEED_M_S = 1.0


def record(flight: SampleFlight) -> Sample:
    """The tick with the largest yaw rate among those in which a trajectory is followed at speed.

    The stage is run again over what it saw in flight, which gives its commands again, to the bit.

    :raises NoSampleError: if it does not, or there is no such tick.
    """
    best: Sample | None = None
    most = 0.0
    for sample, command in _replayed(flight):
        if np.hypot(*command[:2]) > _AT_SPEED_M_S and abs(command[3]) > most:
            best, most = sample, abs(command[3])
    if best is None:
        raise NoSampleError("no trajectory was followed in flight")
    return best


def _replayed(flight: SampleFlight) -> Iterator[tuple[Sample, NDArray[np.float64]]]:
    """Input of the kernel and command of each tick in which a trajectory is followed."""
    messages, flown = flight.messages, follower(MissionSpec())
    verdicts, plans = deque(messages["collision_check"]), deque(messages["trajectory"])
    taken: list[tuple[NDArray[np.uint8], NDArray[np.float64]]] = []
    for measured, sent in zip(messages["odometry"], messages["command"], strict=False):
        while verdicts and verdicts[0].ready_ns <= measured.ready_ns:
            flown.take_verdict(*verdict(decoded("collision_check", cdr(verdicts.popleft()))))
        while plans and plans[0].ready_ns <= measured.ready_ns:
            message = cdr(plans.popleft())
            made = plan(decoded("trajectory", message))
            flown.take_trajectory(*made[:3])
            taken.append((message, made.points))
        now_s, here = measured.ready_ns / 1e9, state(decoded("odometry", cdr(measured)))
        motion = now_s, here.position, here.velocity, here.yaw
        curve = flown.curve(*motion)
        before = flown.state.copy()
        command = flown.command(*motion, TICK_NS / 1e9)
        if not np.array_equal(command, _numbers_of(decoded("command", cdr(sent)))):
            raise NoSampleError(f"the messages of the flight do not give its command at {now_s} s")
        for message, points in taken:
            if points is curve:
                tick = {"now_s": np.array(now_s), "odometry": cdr(measured), "state": before}
                yield tick | {"trajectory": message}, command


class PidTrial(KernelTrial):
    """One flight command: vx, vy, vz, m/s, and yaw rate, rad/s."""

    def __init__(self, _: str, sample: Sample) -> None:
        self._trajectory = plan(decoded("trajectory", sample["trajectory"])).points
        self._now_s = float(sample["now_s"])
        self._here = state(decoded("odometry", sample["odometry"]))
        self._state = sample["state"].copy()
        self._rest = tuning(PILOTS["guarded"], ALL_GUARDS), np.zeros(REPORT_SIZE)
        self.command = np.full(4, np.nan)

    def run(self) -> None:
        """Compute the flight command of the sample."""
        position, velocity, _, yaw = self._here
        here = position, velocity, yaw, TICK_NS / 1e9
        self.command = pid(self._trajectory, self._now_s, *here, self._state, *self._rest)

    def values(self) -> NDArray[np.float64]:
        """The flight command that was computed."""
        return self.command

    def image(self) -> bytes:
        """The command and the controller's state."""
        return super().image() + self._state.tobytes()


def _numbers_of(command: TwistStamped) -> NDArray[np.float64]:
    twist = command.twist
    return np.array([twist.linear.x, twist.linear.y, twist.linear.z, twist.angular.z])
