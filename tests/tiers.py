"""The tiers of the test suite: each test has exactly one, and a unit test that starts a process fails.

``unit``     starts no process; all of them take less than a minute. ``python3 launch.py unit``
``process``  everything else of the gate: fork servers, commands, services, traced programs
``browser``  needs Chromium
``soak``     loops over many seeds, and long tests that repeat a short one. ``python3 launch.py soak``

A test has the tier that a marker on it (or on its module, by ``pytestmark``) names. Without one it is
``browser`` if it is given a browser, and ``unit`` if its path is in :data:`UNIT` and it is given nothing of
:data:`STARTING`; all others are ``process``.
"""

import sys
from pathlib import Path

import pytest

TIERS = ("unit", "process", "browser", "soak")

UNIT = (
    "tests/dashboard/api/processes/test_event_bus.py",
    "tests/dashboard/api/routes/test_streaming.py",
    "tests/dashboard/api/test_security.py",
    "tests/dashboard/campaigns/results",
    "tests/dashboard/campaigns/statistics",
    "tests/dashboard/campaigns/test_flight_record.py",
    "tests/dashboard/campaigns/test_state_machine.py",
    "tests/dashboard/analysis/test_bits.py",
    "tests/dashboard/analysis/test_why.py",
    "tests/dashboard/design/test_designs.py",
    "tests/dashboard/design/test_overheads.py",
    "tests/dashboard/design/test_paired_strikes.py",
    "tests/dashboard/design/test_prediction.py",
    "tests/dashboard/design/test_protections.py",
    "tests/dashboard/design/test_second_computer.py",
    "tests/dashboard/design/test_specification.py",
    "tests/dashboard/web/charts/test_run_data.py",
    "tests/dashboard/web/components/test_views.py",
    "tests/deploy/compose/test_folder.py",
    "tests/deploy/compose/test_logs.py",
    "tests/deploy/compose/test_state_machine.py",
    "tests/deploy/config/test_platform.py",
    "tests/deploy/mission/test_harm.py",
    "tests/deploy/recording/test_flight_status.py",
    "tests/deploy/recording/test_mcap_recorder.py",
    "tests/deploy/recording/test_ordering.py",
    "tests/deploy/recording/test_recorder.py",
    "tests/deploy/recording/test_snapshot.py",
    "tests/deploy/ros2/test_package.py",
    "tests/deploy/workers/test_installation.py",
    "tests/detector/schemes/test_gaussian.py",
    "tests/detector/schemes/test_kinematic.py",
    "tests/detector/series",
    "tests/injector/isa/test_aarch64_registers.py",
    "tests/injector/isa/test_x86_64_decoder.py",
    "tests/injector/strikes/test_recorded_bus.py",
    "tests/release/test_dependencies.py",
    "tests/services/bus",
    "tests/services/control",
    "tests/services/models",
    "tests/services/perception",
    "tests/services/planning/test_goals.py",
    "tests/services/planning/test_pilot.py",
    "tests/services/planning/test_polyline.py",
    "tests/services/planning/test_sweep.py",
    "tests/services/planning/test_trajectory.py",
    "tests/services/planning/test_voxels.py",
    "tests/services/recovery/test_recovery.py",
    "tests/services/runtime/test_clock.py",
    "tests/services/runtime/test_kernel_timer.py",
    "tests/services/runtime/test_latency.py",
    "tests/services/runtime/test_source_fault.py",
    "tests/sim/mission",
    "tests/sim/test_world.py",
    "tests/sim/vehicle",
    "tests/test_mutants.py",
    "tests/test_docstrings.py",
    "tests/test_names.py",
    "tests/test_sizes.py",
    "tests/test_tiers.py",
)
"""Folders and modules whose tests start no process and are quick."""

STARTING = {"server", "server_", "service", "client", "postgresql_server", "laboratory", "may_inject"}
"""Fixtures that start processes."""

_ROOT = Path(__file__).parents[1]
_EVENTS = ("subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn", "os.system")
_running: list[str] = []


def tier_of(item: pytest.Item) -> str:
    """The tier of a test.

    :raises pytest.UsageError: if markers name several.
    """
    named = sorted({mark.name for mark in item.iter_markers() if mark.name in TIERS})
    if len(named) > 1:
        message = f"{item.nodeid}: is of the tiers {', '.join(named)}; name one"
        raise pytest.UsageError(message)
    if named:
        return named[0]
    given = set(getattr(item, "fixturenames", ()))
    if "browser" in given:
        return "browser"
    drawn = getattr(getattr(item, "callspec", None), "params", {}).values()
    if given & STARTING or any(one == "postgresql" for one in drawn if isinstance(one, str)):
        return "process"
    place = item.path.relative_to(_ROOT).as_posix() if item.path.is_relative_to(_ROOT) else ""
    return "unit" if any(place == one or place.startswith(f"{one}/") for one in UNIT) else "process"


def sort_into_tiers(items: list[pytest.Item]) -> None:
    """Mark each test with its tier."""
    for item in items:
        tier = tier_of(item)
        if item.get_closest_marker(tier) is None:
            item.add_marker(tier)


def guard(item: pytest.Item | None) -> None:
    """From now on ``item`` is run, or nothing: a unit test, its fixtures too, may start no process."""
    _running[:] = [item.nodeid] if item is not None and item.get_closest_marker("unit") is not None else []


def _refuse(event: str, _: tuple[object, ...]) -> None:
    if _running and event in _EVENTS:
        message = f"{_running[0]} is a unit test and starts a process ({event}): mark it pytest.mark.process"
        raise RuntimeError(message)


sys.addaudithook(_refuse)
