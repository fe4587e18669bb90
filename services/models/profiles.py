"""The table of profiles: named sets of fields of a mission."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from services.models.base import Strict
from services.models.equipment import Camera, MapSettings, Motion

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
