"""Outputs are the same, within a tolerance, or what a comparator says."""

import sys
from pathlib import Path

import pytest

from injector.program.comparison import (
    RunOutput,
    UnsuitableProgramError,
    compared_by,
    deviation_of,
    digest_of,
)


def deviation(tmp_path: Path, run: str | bytes, golden: str) -> float | None:
    (tmp_path / "run").write_bytes(run if isinstance(run, bytes) else run.encode())
    (tmp_path / "golden").write_text(golden)
    return deviation_of(tmp_path / "run", tmp_path / "golden")


@pytest.mark.parametrize(
    ("run", "golden", "expected"),
    [
        ("x = 1.5 m\n", "x = 1.5 m\n", 0.0),
        ("x = 1.0 m, -2e3\n", "x = 2.0 m, -2e3\n", 0.5),
        ("1 10", "1 8", 0.2),
        ("2 10", "1.9 5", 0.5),
        ("0", "5", 1.0),
        ("-1", "1", 2.0),
        ("1 2 3", "1 2", None),
        ("x = 1", "y = 1", None),
        ("x = nan", "x = 1.0", None),
        (b"\xff\xfe 1", "1", None),
    ],
)
def test_the_largest_relative_deviation(
    tmp_path: Path, run: str | bytes, golden: str, expected: float | None
) -> None:
    assert deviation(tmp_path, run, golden) == expected


def test_what_is_not_there_has_no_deviation(tmp_path: Path) -> None:
    assert deviation_of(tmp_path / "none", tmp_path / "none") is None
    assert digest_of(tmp_path / "none") == "absent"


def test_what_differs_is_named() -> None:
    golden = RunOutput(0, (("stdout", "a"), ("stderr", "b")))
    assert golden.differs_from(golden) == ""
    assert RunOutput(0, (("stdout", "a"), ("stderr", "c"))).differs_from(golden) == "stderr"
    assert RunOutput(2, golden.digests).differs_from(golden) == "exit status 2, not 0"


def test_a_comparator_says_by_its_exit_status(tmp_path: Path) -> None:
    def says(script: str) -> bool:
        return compared_by([sys.executable, "-c", script], str(tmp_path), tmp_path / "a", tmp_path / "b")

    assert says("")
    assert says("import sys; assert sys.argv[1][-1] + sys.argv[2][-1] == 'ab'")
    assert not says("raise SystemExit(1)")
    assert says(f"import os; assert os.getcwd() == {str(tmp_path.resolve())!r}")
    with pytest.raises(UnsuitableProgramError, match=r"exit status 3, expected 0 \(the same\) or 1"):
        says("raise SystemExit(3)")
    with pytest.raises(UnsuitableProgramError, match="no-such-comparator"):
        compared_by(["no-such-comparator"], str(tmp_path), tmp_path, tmp_path)
