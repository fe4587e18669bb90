"""Faults in kernels alone: classified, the same whoever makes them, gone on with, nothing left behind."""

import json
import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from deploy.config.check import check_kernel
from deploy.errors import BadSpecError
from deploy.kernel_study.file import KernelSection, StudyFile, kept_runs
from deploy.kernel_study.study import Study
from deploy.kernel_study.workers import kernel_worker
from injector.kernel_study.results import StudyRun
from services.models.faults.specification import FaultSpec
from tests.conftest import descendants, wait_until

SEED = 1


def studied(fault: FaultSpec, injections: int, slots: int = 1, file: Path | None = None) -> list[StudyRun]:
    kept = StudyFile(file)
    try:
        section = kept.section(fault.target, fault, SEED)
        runs = Study(kernel_worker(fault.target), fault, injections, SEED, slots, section).run()
        section.finish(runs)
    finally:
        kept.close()
    return runs


@pytest.mark.parametrize(
    "studies", [(("pid", 16),), pytest.param((("rrt", 24), ("pid", 40)), marks=pytest.mark.soak)], ids=len
)
def test_the_same_seed_gives_the_same_records_whoever_makes_them(
    tmp_path: Path, studies: tuple[tuple[str, int], ...]
) -> None:
    """Of a short call, and of a long one; by one worker and by two."""
    before = descendants(os.getpid())
    for kernel, injections in studies:
        fault = FaultSpec(target=kernel)
        files = [tmp_path / f"{kernel}{slots}" for slots in (1, 2)]
        runs = [studied(fault, injections, slots, file) for slots, file in zip((1, 2), files, strict=True)]
        assert len(runs[0]) == injections
        assert files[0].read_bytes() == files[1].read_bytes()
        assert {one.injection.precision for one in runs[0]} == {"exact"}
        for one in runs[0]:
            assert (one.result == "not_injected") == (one.injection.status != "injected")
            if one.injection.status == "injected":
                assert one.injection.before != one.injection.after == one.injection.read_back
        # A flipped pointer kills, a flipped number in a dead register does nothing.
        assert {"benign", "crash"} <= {one.result for one in runs[0]}
        assert all(one.cause for one in runs[0] if one.result == "crash")
    assert descendants(os.getpid()) == before


@pytest.mark.soak
def test_a_study_draws_the_masks_of_a_histogram() -> None:
    histogram = {"bits": {2: 0.5, 3: 0.5}}
    fault = FaultSpec.model_validate({"target": "pid", "mask": "histogram", "histogram": histogram})
    runs = studied(fault, 40)
    assert {len(one.injection.bits) for one in runs if one.injection.status == "injected"} == {2, 3}


def test_without_the_flip_all_is_benign() -> None:
    runs = studied(FaultSpec(target="pid", model="none"), 40)
    struck = [one for one in runs if one.injection.bits]
    assert len(struck) > 30
    assert {one.result for one in struck} == {"benign"}
    assert {one.injection.status for one in runs} == {"not_activated"}


@pytest.mark.soak
def test_a_stuck_register_leads_to_a_result_too() -> None:
    fault = FaultSpec(target="pid", model="stuck_at", stuck_value=1, stuck_instructions=200)
    assert {one.result for one in studied(fault, 8)} <= {"benign", "sdc", "crash", "hang", "not_injected"}


KILLED = """
import sys
from functools import partial
from pathlib import Path
from tests.deploy.kernel_study.test_study import studied
from services.models.faults.specification import FaultSpec
studied(FaultSpec(target="pid"), 60, 2, Path(sys.argv[1]))
"""


def has_lines(file: Path, lines: int) -> bool:
    return file.exists() and file.read_bytes().count(b"\n") >= lines


@pytest.mark.soak
def test_a_study_that_is_killed_is_gone_on_with_to_the_same_end(tmp_path: Path) -> None:
    before = descendants(os.getpid())
    whole, file = tmp_path / "whole", tmp_path / "killed"
    studied(FaultSpec(target="pid"), 60, 1, whole)
    for lines in (8, 30):
        one = subprocess.Popen([sys.executable, "-c", KILLED, str(file)], cwd=Path(__file__).parents[3])
        wait_until(partial(has_lines, file, lines), 120)
        one.send_signal(signal.SIGKILL)
        one.wait()
        wait_until(lambda: descendants(os.getpid()) == before)
    kept = file.read_bytes()
    file.write_bytes(kept + b'{"run":{"kernel":"pid"')  # as if it had been killed while it wrote
    studied(FaultSpec(target="pid"), 60, 1, file)
    assert file.read_bytes() == whole.read_bytes()
    # What was kept beyond the last one that counts was more than asked for, and is gone.
    last = max(kept_runs(whole)["pid"], key=lambda run: run.index).index
    counted = [line for line in kept.splitlines() if b'"run"' not in line or index_of(line) <= last]
    assert len(counted) > 1
    assert set(counted) <= set(whole.read_bytes().splitlines())


def index_of(line: bytes) -> int:
    return int(json.loads(line)["run"]["index"])


def test_a_file_is_refused_that_is_of_another_study_or_in_use(tmp_path: Path) -> None:
    file = tmp_path / "study"
    studied(FaultSpec(target="pid"), 2, 1, file)
    kept = StudyFile(file)
    with pytest.raises(BadSpecError, match="another study is writing it"):
        StudyFile(file)
    with pytest.raises(BadSpecError, match="another fault or seed"):
        kept.section("pid", FaultSpec(target="pid", bits=2), SEED)
    assert isinstance(kept.section("pid", FaultSpec(target="pid"), SEED), KernelSection)
    kept.close()
    file.write_text("a diary\n")
    with pytest.raises(BadSpecError, match="no file of a kernel study"):
        StudyFile(file)


def test_an_unknown_kernel_is_refused() -> None:
    with pytest.raises(BadSpecError, match="unknown kernel 'wings'; known: point_cloud"):
        check_kernel("wings")
