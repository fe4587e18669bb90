"""The table of studies: each experiment of the paper and of ours, and the campaign that flies it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.resources import files
from types import MappingProxyType
from typing import NamedTuple

from dashboard.campaigns.presets import presets
from dashboard.studies.paper import FINDINGS, STUDIES, PaperValue


class MissionStudy(NamedTuple):
    """An experiment that is flown by the preset of its name.

    ``against`` is the arm beside which the others are compared, None for the golden twins. ``alone`` are
    the kernels that are struck alone as well, to compare their ranking with that in flight.
    """

    name: str
    against: str | None = None
    alone: Sequence[str] = ()

    @property
    def findings(self) -> Sequence[PaperValue]:
        """The numbers of the paper that it is held against; none if the paper has none."""
        return FINDINGS.get(self.name, [])

    @property
    def title(self) -> str:
        """What it is about, in a line."""
        return next(preset.about for preset in presets() if preset.name == self.name)

    @property
    def about(self) -> str:
        """What the head of its preset says: the question, and what the paper found."""
        lines = (files("dashboard") / "presets" / f"{self.name}.toml").read_text().splitlines()[1:]
        head = []
        for line in lines:
            if not line.startswith("#"):
                break
            head.append(line.removeprefix("#").strip())
        return " ".join(head).strip()


_BESIDE = {
    **dict.fromkeys(("fig8", "fig9", "table3"), "golden"),
    **dict.fromkeys(("table4", "fig14", "recovery"), "bare"),
    "guards": "baseline",
}

_ALONE = {
    "kernel-vs-system": (
        "point_cloud",
        "octomap",
        "collision_check",
        "rrt",
        "rrt_connect",
        "rrt_star",
        "trajectory",
        "pid",
    )
}

OURS = ("kernel-vs-system", "guards", "recurrence", "difficulty", "wind", "recovery")
"""The studies that the paper has not."""

TABLE: Mapping[str, MissionStudy] = MappingProxyType(
    {name: MissionStudy(name, _BESIDE.get(name), _ALONE.get(name, ())) for name in (*STUDIES, *OURS)}
)
