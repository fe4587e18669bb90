"""What stages must agree on to keep the vehicle off obstacles: its body, its speed, its brakes."""

from __future__ import annotations

# Safety body, an upright cylinder: facts page, "collision check".
BODY_RADIUS_M = 1.5
BODY_HEIGHT_M = 0.6

SPEED_LIMIT_M_S = 3.0
"""Planned and commanded: facts page, "smoothing" and "control"."""

BRAKE_BELOW_S = 2.0
"""A collision nearer than this is braked for by control, and answered by planning from a standstill: a
second from full speed to rest, a frame of perception and its latency. One farther off leaves planning
the time to lead around it in flight."""

DECELERATION_M_S2 = 4.0
"""At which control stops the vehicle, and planning expects it to."""
