"""Names of the coordinate frames, after ROS REP 105 and REP 103: what a header's ``frame_id`` may say.

``map`` and ``odom`` are the world, x and y level, z up, in m; they coincide, as nothing on board corrects
odometry. ``base_link`` is the vehicle: origin in its centre of mass, x forward, y left, z up. The camera sits
there, ``camera_link`` with the vehicle's axes, ``camera_optical_frame`` with x right, y down, z forward.
"""

from __future__ import annotations

MAP = "map"
ODOM = "odom"
BASE_LINK = "base_link"
CAMERA_LINK = "camera_link"
CAMERA_OPTICAL = "camera_optical_frame"
