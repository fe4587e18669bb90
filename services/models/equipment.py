"""What a flight carries and meets, as fields of a mission: sensors, map, limits of motion, wind; profiles."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from pydantic import Field

from services.models.base import Strict


class Camera(Strict):
    """The depth camera. The default keeps the authors' field of view and aspect ratio at a quarter of
    their pixels a side.

    Depth z is read with a standard deviation of ``noise_per_m`` z^2, as of any stereo camera, and
    rounded to ``quantisation_m``; 0 leaves either out.
    """

    width: int = Field(default=64, ge=4, le=1280)
    height: int = Field(default=36, ge=4, le=960)
    fov_deg: float = Field(default=90.0, ge=10, le=150, description="horizontal")
    range_m: float = Field(default=20.0, gt=0, le=200)
    noise_per_m: float = Field(default=0.001, ge=0, le=0.1)
    quantisation_m: float = Field(default=0.001, ge=0, le=1)


class Imu(Strict):
    """The inertial measurement unit: white noise of each sample, a bias drawn once a flight."""

    rate_hz: float = Field(default=190.0, gt=0, le=250, description="at most one sample a physics step")
    gyro_noise_rad_s: float = Field(default=0.002, ge=0, le=10)
    gyro_bias_rad_s: float = Field(default=0.003, ge=0, le=10)
    accel_noise_m_s2: float = Field(default=0.02, ge=0, le=100)
    accel_bias_m_s2: float = Field(default=0.05, ge=0, le=100)


class Odometry(Strict):
    """Odometry is exact unless its position drifts: a random walk, metres per root of a second."""

    drift_m_sqrt_s: float = Field(default=0.0, ge=0, le=10)


class MapSettings(Strict):
    """The occupancy map. Half a metre is coarser than the authors' 0.1 m: a frame takes 4 ms instead of
    200 ms, and the safety body of 1.5 m hides a quarter of a metre of rounding. The authors used a range
    of 7 m; at 3 m/s and a reaction time of 0.7 s the other 3 m turn most emergency stops into a turn in
    flight.
    """

    resolution_m: float = Field(default=0.5, ge=0.05, le=1.0)
    range_m: float = Field(default=10.0, ge=1, le=50)


class Motion(Strict):
    """Limits of the planned motion: facts page, "smoothing"."""

    speed_m_s: float = Field(default=3.0, ge=0.2, le=3.0, description="control flies no faster")
    acceleration_m_s2: float = Field(default=5.0, ge=0.5, le=5.0)


class Wind(Strict):
    """Air that moves: a steady wind and gusts of the given standard deviation, world frame.

    The default is what the Dryden model gives 2 to 3 m above ground in a light breeze of 3 m/s without
    the breeze itself (``docs/world.md``).
    """

    mean_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gust_m_s: tuple[float, float, float] = (0.6, 0.6, 0.3)
    correlation_s: float = Field(default=1.0, gt=0, le=600)


class Link(Strict):
    """The link between the companion computer and the sensors and flight controller of the vehicle.

    What goes over it, each way, comes ``delay_ms`` of virtual time later; of the messages of a topic the
    share ``loss`` never comes. Both are of the mission: its golden twin loses the same messages.
    """

    delay_ms: float = Field(default=0.0, ge=0, le=1000, description="virtual time, each way")
    loss: float = Field(default=0.0, ge=0, lt=1, description="probability of each message")

    @property
    def delay_ns(self) -> int:
        """How much later a message comes, in nanoseconds."""
        return round(self.delay_ms * 1e6)

    @property
    def is_ideal(self) -> bool:
        """Whether it neither delays nor loses anything."""
        return self.delay_ms == self.loss == 0


PROFILES: Mapping[str, Mapping[str, Strict]] = MappingProxyType(
    {
        # The defaults of every field: tuned for speed, same outcomes.
        "fast": {},
        # Published parameters: facts page, "Pipeline values". Of the published 0.1 to 0.2 m the
        # coarser voxel: the finer one costs eight times as much and flies alike.
        "paper": {
            "camera": Camera(width=256, height=144),
            "mapping": MapSettings(resolution_m=0.2, range_m=7.0),
            "motion": Motion(speed_m_s=3.0, acceleration_m_s2=5.0),
        },
    }
)
"""Named sets of fields of a mission."""
