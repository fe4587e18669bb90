"""What the simulated world costs: CPU of physics, camera and sensors per 95 s of flight.

``python -m tests.bench.world [PROFILE] [WORLD]``: figures are of this machine, as it is loaded now. The
camera exposes one frame in eight, as a perception that takes 300 ms (i9-9940X) lets it.
"""

import sys
import time

import numpy as np

from services.bus.topics import TICK_NS
from services.models.mission import MissionSpec
from sim.flight import SimulatedFlight
from sim.sensors.camera import DepthCamera

FLIGHT_S = 95.0
FRAME_EVERY = 8


def main() -> None:
    profile, world = (*sys.argv[1:], "fast", "sparse")[:2] if len(sys.argv) < 3 else sys.argv[1:3]
    spec = MissionSpec.model_validate({"profile": profile, "world": world, "seed": 7})
    flight, camera = SimulatedFlight(spec), DepthCamera(spec.camera, spec.seed)
    flight.advance(0, [(0, np.zeros(4))])
    camera.render(flight.vehicle)
    ticks = round(FLIGHT_S * 1e9 / TICK_NS)
    flying = seeing = 0
    for tick in range(1, ticks + 1):
        angle = 2 * np.pi * tick / 250
        # A command of each tick takes effect in its middle, as control's does.
        command = np.array([0.5 * np.cos(angle), 0.5 * np.sin(angle), 0.2 * np.cos(3 * angle), 0.6])
        begin = time.thread_time_ns()
        flight.advance(tick * TICK_NS, [(tick * TICK_NS + 460_000, command)])
        assert flight.felt is not None
        middle = time.thread_time_ns()
        if tick % FRAME_EVERY == 0:
            camera.render(flight.vehicle)
        flying += middle - begin
        seeing += time.thread_time_ns() - middle
    assert not flight.vehicle.contact
    total = (flying + seeing) / 1e9
    print(
        f"profile {profile}, {world}: {total:.2f} s of CPU per {FLIGHT_S:.0f} s of flight:"
        f" physics, IMU and energy {flying / 1e9:.2f} s, camera {seeing / 1e9:.2f} s"
        f" ({seeing / 1e3 / (ticks // FRAME_EVERY):.0f} us a frame)"
    )


if __name__ == "__main__":
    main()
