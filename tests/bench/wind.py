"""How much wind a vehicle holds against: drift in hover, ground speed against the wind, loss of height.

``python -m tests.bench.wind [AIRFRAME]``. A steady wind along the way with gusts of a fifth of it, 30 s each;
no stage flies, the flight controller alone is asked for hover and for 3 m/s against the wind.
"""

import sys

import numpy as np

from services.models.equipment import Wind
from services.models.world import BoxWorld
from sim.vehicle.airframe import airframe
from sim.vehicle.vehicle import STEP_S, Vehicle
from sim.vehicle.wind import Air
from sim.world import make_world

SPEEDS_M_S = (0, 4, 8, 10, 12, 14, 16, 18, 20, 22, 24)
TIME_S = 30.0
OPEN = BoxWorld(
    name="open",
    kind="boxes",
    start=(0.0, 0.0, 60.0),
    goal=(400.0, 0.0, 60.0),
    lower=(-2000.0, -1000.0, 0.0),
    upper=(1000.0, 1000.0, 500.0),
    boxes=((900.0, 900.0, 0.0, 901.0, 901.0, 1.0),),
)


def main() -> None:
    frame = airframe(sys.argv[1] if len(sys.argv) > 1 else "airsim")
    world = make_world(OPEN, 0)
    print("| wind m/s | speed in hover m/s | speed at 3 m/s upwind | lowest below the start m |")
    print("|---|---|---|---|")
    for speed in SPEEDS_M_S:
        wind = Wind(mean_m_s=(-float(speed), 0.0, 0.0), gust_m_s=(0.2 * speed, 0.2 * speed, 0.1 * speed))
        told, lowest = [], 0.0
        for command in (0.0, 3.0):
            vehicle = Vehicle(world, frame, Air(wind, 0, STEP_S))
            track = vehicle.advance(np.array([command, 0.0, 0.0, 0.0]), round(TIME_S / STEP_S))
            settled = track[len(track) // 3 :]
            told.append(float(settled[-1, 1] - settled[0, 1]) / (settled[-1, 0] - settled[0, 0]))
            lowest = max(lowest, float(track[0, 3] - track[:, 3].min()))
        print(f"| {speed} | {told[0]:+.2f} | {told[1]:+.2f} | {lowest:.1f} |", flush=True)


if __name__ == "__main__":
    main()
