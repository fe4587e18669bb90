"""What a package may add to zenfi by an entry point: the classes that its objects are of.

Beside these: :class:`services.models.pilots.Pilot`,
:class:`services.models.faults.mask_histogram.MaskHistogram` and ``detector.schemes.base.Scheme``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from services.models.base import Strict

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class OmplPlanner:
    """A planner with OMPL's interface, of the group ``zenfi.planners``.

    ``make`` makes it of an ``ompl.base.SpaceInformation``. It must draw from OMPL's generator only and stay
    in its thread. On a platform that does not list it, it takes as long as the kernel ``latency_as``. Faults
    strike the code of the shared libraries whose files begin with one of ``modules``.
    """

    make: Callable[[Any], Any]
    latency_as: str = "rrt_star"
    modules: tuple[str, ...] = ("libompl",)


@dataclass(frozen=True, slots=True)
class MessageGuard:
    """A guard that refuses messages, of the group ``zenfi.guards``; it acts where a mission names it.

    ``refuses`` is given the topic and the message of each input of its ``stages`` that the other checks let
    pass. It answers what is wrong with it, or an empty text. It may depend on nothing else.
    """

    stages: tuple[Literal["perception", "planning", "control"], ...]
    does: str
    costs: str
    refuses: Callable[[str, Any], str]


class NoParameters(Strict):
    """Of a generator that has none."""


@dataclass(frozen=True, slots=True)
class WorldGenerator:
    """A generator of worlds, of the group ``zenfi.worlds``.

    ``draw`` is given the definition (its area, start and goal), the ``parameters`` and a random generator,
    of which alone its result may depend: boxes (n, 6), lower and upper corner x y z in m, world frame. Those
    that keep start or goal from being free are left out, and it is asked again until one is in the way.
    """

    about: str
    draw: Callable[[Any, Any, np.random.Generator], Floats]
    parameters: type[Strict] = NoParameters


@dataclass(frozen=True, slots=True)
class Signal:
    """What properties may speak of, of the group ``zenfi.signals``: an oracle of one's own.

    ``values`` is given the mission's specification, the true path of the flight and that of its golden twin
    (:class:`sim.mission.true_path.TruePath`); it answers one number for each time of the path, in the unit
    that ``about`` says.
    """

    about: str
    values: Callable[[Any, Any, Any], Floats]
