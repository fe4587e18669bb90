"""Every kernel of the table runs alone on its recorded input, and its outputs can be compared."""

import importlib
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from services.kernels import KERNELS, PLANNERS, Kernel
from services.perception import samples as perception
from services.planning import samples as planning
from services.runtime.kernel_trial import KernelOutput

every_kernel = pytest.mark.parametrize("kernel", KERNELS.values(), ids=KERNELS)
every_planner = pytest.mark.parametrize("planner", PLANNERS)

SMALL_BYTES = 100_000


def made(kernel: Kernel) -> KernelOutput:
    trial = kernel.trial(kernel.sample())
    trial.run()
    return trial.output()


def test_the_table_is_cheap_to_import() -> None:
    heavy = ("numpy", "numba", "ompl", "pyoctomap", "zenoh", "rosbags")
    script = f"import sys, services.kernels; print([name for name in {heavy} if name in sys.modules])"
    answer = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "[]"


@every_kernel
def test_the_entry_is_there(kernel: Kernel) -> None:
    module, _, path = kernel.entry.partition(":")
    entry = importlib.import_module(module)
    for name in path.split("."):
        entry = getattr(entry, name)
    assert callable(entry)


@every_kernel
def test_the_sample_is_small(kernel: Kernel) -> None:
    assert 0 < kernel.sample_file.stat().st_size < SMALL_BYTES


@every_kernel
def test_a_fresh_trial_gives_the_same_bits(kernel: Kernel) -> None:
    one, other = made(kernel), made(kernel)
    assert len(one.values)
    assert kernel.exact(one, other)
    assert kernel.within_tolerance(one, other)


@every_kernel
def test_the_state_of_one_trial_is_not_that_of_another(kernel: Kernel) -> None:
    sample = kernel.sample()
    first, second = kernel.trial(sample), kernel.trial(sample)
    first.run()
    first.run()
    second.run()
    assert kernel.exact(second.output(), made(kernel))


@every_kernel
def test_the_comparison_tells_a_bit_from_what_matters(kernel: Kernel) -> None:
    golden = made(kernel)
    last_bit = KernelOutput(golden.image[:-1] + bytes([golden.image[-1] ^ 1]), golden.values)
    assert not kernel.exact(golden, last_bit)
    assert kernel.within_tolerance(golden, last_bit)
    tolerance = np.array(kernel.tolerance)
    for sign in (-1.0, 1.0):
        slightly = golden._replace(values=golden.values + sign * 0.9 * tolerance)
        plainly = golden._replace(values=golden.values + sign * (1.1 * tolerance + 1e-6))
        assert kernel.within_tolerance(golden, slightly)
        assert not kernel.within_tolerance(golden, plainly)
    fewer = golden._replace(values=golden.values[:-1])
    no_numbers = golden._replace(values=np.full_like(golden.values, np.nan))
    assert not kernel.within_tolerance(golden, fewer)
    assert not kernel.within_tolerance(golden, no_numbers)


def test_two_outputs_without_an_end_are_the_same() -> None:
    never = KernelOutput(b"", np.array([np.inf]))
    assert KERNELS["collision_check"].within_tolerance(never, never)
    assert not KERNELS["collision_check"].within_tolerance(never, KernelOutput(b"", np.array([1.0])))


@every_planner
def test_the_planners_have_to_look_for_a_way_around(planner: str) -> None:
    sample = KERNELS[planner].sample()
    problem = planning.PlannerTrial(planner, sample)
    grid, departure = planning.problem(sample)
    assert not grid.edge_clear(departure.position, sample["goal"])
    problem.run()
    assert problem.path is not None
    assert len(problem.path) > 2
    legs = np.linalg.norm(np.diff(problem.path, axis=0), axis=1)
    assert legs.sum() > 1.01 * np.linalg.norm(problem.path[-1] - problem.path[0])


def test_the_frame_changes_the_map() -> None:
    kernel = KERNELS["octomap"]
    before = perception.OctomapTrial("octomap", kernel.sample()).output()
    assert not kernel.within_tolerance(before, made(kernel))
    # It had been seen before: there are free and occupied voxels.
    assert (before.values == 0.0).sum() > 1000
    assert (before.values == 1.0).sum() > 100


def test_the_check_finds_a_collision_ahead() -> None:
    assert 0.0 < made(KERNELS["collision_check"]).values[0] < 5.0


def test_the_command_is_one_of_a_turn_in_flight() -> None:
    command = made(KERNELS["pid"]).values
    assert np.hypot(command[0], command[1]) > 1.0
    assert abs(command[3]) > 0.1


def test_a_kernel_says_which_column_may_differ_by_how_much() -> None:
    kernel = replace(KERNELS["trajectory"], tolerance=(0.0,) * 12)
    golden = made(kernel)
    later = golden.values + np.eye(12)[0] * 0.01
    assert not kernel.within_tolerance(golden, golden._replace(values=later))
    assert KERNELS["trajectory"].within_tolerance(golden, golden._replace(values=later))
