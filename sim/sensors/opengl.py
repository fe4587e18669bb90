"""Whether this machine renders offscreen, found out by doing it in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys

BACKENDS = ("egl", "osmesa")
_PROBE_TIMEOUT_S = 60


def backend() -> str | None:
    """The value of ``MUJOCO_GL`` with which this machine renders, None if there is none."""
    for name in BACKENDS:
        try:
            tried = subprocess.run(
                [sys.executable, "-P", "-m", "sim.sensors.rgb"],
                env={**os.environ, "MUJOCO_GL": name},
                capture_output=True,
                check=False,
                timeout=_PROBE_TIMEOUT_S,
            )
        except subprocess.TimeoutExpired:
            continue
        if tried.returncode == 0:
            return name
    return None
