"""What a worker is asked: one line of JSON for each run."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from services.bus.mission import MissionSpec
from services.bus.model import Strict


class Order(Strict):
    """A mission to fly, and the file to record it in, if it is to be recorded."""

    spec: MissionSpec
    record: Path | None = None
    live: Path | None = Field(default=None, description="socket of who shows flights while they are flown")
    about: dict[str, str] = Field(default={}, description="what the recording says beside the specification")
