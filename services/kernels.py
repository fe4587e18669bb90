"""The table of kernels: the only place where a kernel is declared.

To import it is cheap. A kernel's sample and trial are found by name when they are asked for::

    kernel = KERNELS["octomap"]
    sample = kernel.sample()
    golden = kernel.trial(sample)   # state made anew
    golden.run()                    # the kernel, once, and nothing else
    kernel.exact(golden.output(), faulty.output())
    kernel.within_tolerance(golden.output(), faulty.output())
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal

from services.system import plug_ins

if TYPE_CHECKING:
    from services.models.faults.specification import FaultSpec
    from services.runtime.kernel_trial import KernelOutput, KernelTrial, Sample


@dataclass(frozen=True, slots=True)
class Kernel:
    """One kernel: its stage, where it is entered, the libraries whose code it runs, and how it is tried.

    ``modules`` are file name prefixes of shared libraries; kernels compiled by numba run in anonymous
    memory and name none. ``trial_class`` is a :class:`services.runtime.kernel_trial.KernelTrial` in the
    stage's ``samples`` module, which says what an output's values are; ``tolerance`` is by how much each of
    their columns may differ (one number: all columns) in ``unit``.
    """

    name: str
    stage: str
    entry: str
    modules: tuple[str, ...]
    trial_class: str
    tolerance: tuple[float, ...]
    unit: str

    @property
    def sample_file(self) -> Path:
        """The recorded input of the stage's kernels, written by ``zenfi bench samples``."""
        return Path(__file__).parent / self.stage / "sample.npz"

    @property
    def samples_module(self) -> str:
        """The module that knows how the stage's kernels are tried."""
        return f"services.{self.stage}.samples"

    def sample(self) -> Sample:
        """The recorded input, loaded from its file."""
        import numpy as np  # noqa: PLC0415 - the table is cheap to import

        with np.load(self.sample_file, allow_pickle=False) as arrays:
            return dict(arrays)

    def trial(self, sample: Sample) -> KernelTrial:
        """The kernel on its input, once; its state is made anew."""
        samples = importlib.import_module(self.samples_module)
        trial: KernelTrial = getattr(samples, self.trial_class)(self.name, sample)
        return trial

    def exact(self, one: KernelOutput, other: KernelOutput) -> bool:
        """Whether two outputs are the same to the bit."""
        return one.image == other.image

    def within_tolerance(self, one: KernelOutput, other: KernelOutput) -> bool:
        """Whether two outputs have as many values, and each pair is equal or within the tolerance."""
        import numpy as np  # noqa: PLC0415

        same_shape = one.values.shape == other.values.shape
        return same_shape and bool(np.isclose(one.values, other.values, rtol=0.0, atol=self.tolerance).all())


_PLAN = "services.planning.planners:plan"


def _planner(name: str, modules: tuple[str, ...] = ("libompl",)) -> Kernel:
    return Kernel(name, "planning", _PLAN, modules, "PlannerTrial", (0.1,), "m at each corner")


_TABLE = (
    Kernel(
        "point_cloud",
        "perception",
        "services.perception.point_cloud:point_cloud",
        (),
        "PointCloudTrial",
        (0.05,),
        "m at each point: the camera's noise at 7 m",
    ),
    Kernel(
        "octomap",
        "perception",
        "services.perception.occupancy:OccupancyMap.insert",
        ("liboctomap",),
        "OctomapTrial",
        (0.0,),
        "label of each voxel: log-odds may differ, what is free or occupied may not",
    ),
    Kernel(
        "collision_check",
        "perception",
        "services.perception.collision:time_to_collision",
        ("liboctomap",),
        "CollisionCheckTrial",
        (0.04,),
        "s: a tick of control",
    ),
    _planner("rrt"),
    _planner("rrt_connect"),
    _planner("rrt_star"),
    _planner("prm_star"),
    Kernel(
        "lawn_mower",
        "planning",
        "services.planning.sweep:lawn_mower",
        (),
        "SweepTrial",
        (0.1,),
        "m at each end of a lane",
    ),
    Kernel(
        "frontier",
        "planning",
        "services.planning.frontier:frontier",
        (),
        "FrontierTrial",
        (0.1,),
        "m: the place to explore next",
    ),
    Kernel(
        "trajectory",
        "planning",
        "services.planning.trajectory:trajectory",
        (),
        "SmoothingTrial",
        (0.04, *(0.1,) * 3, *(0.05,) * 3, *(0.1,) * 3, 0.02, 0.0),
        "s, m, m/s, m/s^2, rad, and whether it turns on the spot",
    ),
    Kernel(
        "pid",
        "control",
        "services.control.pid:pid",
        (),
        "PidTrial",
        (0.02,),
        "m/s and rad/s",
    ),
)

KERNELS: Mapping[str, Kernel] = MappingProxyType({kernel.name: kernel for kernel in _TABLE})


def find_kernel(name: str) -> Kernel | None:
    """The kernel of that name: one of the table, else a planner that another package adds; None: neither.

    :raises UnknownPlugInError: if there is such a planner, but it cannot be used.
    """
    if name in KERNELS or not plug_ins.is_installed("planners", name):
        return KERNELS.get(name)
    return _planner(name, plug_ins.load("planners", name).modules)


def is_planner(name: str) -> bool:
    """Whether a kernel plans: one that a mission chooses one of."""
    return name in PLANNERS or (name not in KERNELS and plug_ins.is_installed("planners", name))


def aimed_at(fault: FaultSpec) -> str:
    """The stage that a fault strikes; one that an own stack replaces goes by its own name."""
    if fault.at_equipment:
        return "sim"
    if fault.level == "instruction":
        if is_planner(fault.target):
            return "planning"
        return KERNELS[fault.target].stage if fault.target in KERNELS else fault.target
    from services.models.inter_kernel_states import members  # noqa: PLC0415 - the table is cheap to import

    return members(fault.target)[0].stage


def scope_of(fault: FaultSpec) -> Literal["kernel", "thread"]:
    """The code that a fault strikes: of a kernel of ours its own, unless all of the thread's is asked for."""
    return fault.scope or ("kernel" if fault.target in KERNELS or is_planner(fault.target) else "thread")


PLANNERS: tuple[str, ...] = tuple(name for name, kernel in KERNELS.items() if kernel.entry == _PLAN)
"""The planners that come along: a mission chooses one of them, or one that another package adds."""

GOAL_KERNELS: Mapping[str, str] = MappingProxyType(
    {"scanning": "lawn_mower", "mapping": "frontier", "search": "frontier"}
)
"""The kernel that chooses the goals of a mission; the other missions have theirs given."""
