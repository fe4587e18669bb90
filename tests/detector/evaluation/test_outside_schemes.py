"""Schemes from outside: programs that answer scores, and packages that are not installed."""

import sys
from pathlib import Path

import numpy as np
import pytest

from detector.evaluation import outside_schemes
from detector.evaluation.coverage import judged
from detector.evaluation.outside_schemes import OutsideSchemeError, ScoringProgram, scheme_in
from detector.schemes.registry import UnknownSchemeError
from detector.series.series import Checks, Series
from tests.detector.flights import flight

CHECK = np.array([[1.0, np.inf], [np.nan, -2.5]])


def program(folder: Path, *lines: str) -> Path:
    path = folder / "scorer"
    path.write_text("\n".join([f"#!{sys.executable}", "import json, os, sys, time", *lines]))
    path.chmod(0o755)
    return path


def ask_thrice(one: ScoringProgram) -> None:
    for _ in range(3):
        one.score("control", CHECK)


def fails(path: Path, says: str) -> None:
    with ScoringProgram(path) as one, pytest.raises(OutsideSchemeError, match=says) as error:
        ask_thrice(one)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_program_is_shown_every_check_and_its_scores_count(tmp_path: Path) -> None:
    shown = tmp_path / "shown"
    path = program(
        tmp_path,
        f"shown = open({str(shown)!r}, 'w')",
        "for number, line in enumerate(sys.stdin):",
        "    print(line, end='', file=shown, flush=True)",
        "    print(1.5 if number == 1 else 0.25, flush=True)",
    )
    checks = Checks(np.arange(8.0).reshape(4, 2), np.array([0, 1, 3]), np.array([1.0, 2.0, 3.0]))
    with ScoringProgram(path) as one:
        found = judged(one, Series({"control": checks}, {"time_s": 3.0}))
    assert found.scores.tolist() == [0.25, 1.5, 0.25]
    assert shown.read_text().splitlines() == [
        '{"stage": "control", "fresh": true, "values": [[0.0, 1.0]]}',
        '{"stage": "control", "fresh": false, "values": [[2.0, 3.0], [4.0, 5.0]]}',
        '{"stage": "control", "fresh": true, "values": [[6.0, 7.0]]}',
    ]


def test_numbers_that_are_none_arrive_as_such(tmp_path: Path) -> None:
    path = program(
        tmp_path,
        "(a, b), (c, d) = json.loads(input())['values']",
        "print(float(a == 1.0 and b == float('inf') and c != c and d == -2.5), flush=True)",
    )
    with ScoringProgram(path) as one:
        assert one.score("control", CHECK) == 1.0


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("print('no', flush=True); time.sleep(60)", "one number in a line"),
        ("print('1.0\\n2.0', flush=True); time.sleep(60)", "one number in a line"),
        ("print('nan', flush=True); time.sleep(60)", "at least 0"),
        ("print('-1', flush=True); time.sleep(60)", "at least 0"),
        ("print('1' * 10**6, flush=True); time.sleep(60)", "one number in a line"),
        ("input(); print(0.5, flush=True); sys.exit(3)", "ended with status 3"),
        ("os.kill(os.getpid(), 9)", "ended with status -9"),
    ],
)
def test_a_program_that_answers_no_score_is_told_of(line: str, says: str, tmp_path: Path) -> None:
    fails(program(tmp_path, line), says)


def test_a_program_that_does_not_answer_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outside_schemes, "ANSWER_S", 0.2)
    fails(program(tmp_path, "time.sleep(60)"), "did not answer within 0.2 s")


def test_what_cannot_be_started_is_told_of(tmp_path: Path) -> None:
    path = tmp_path / "scorer"
    path.write_text("no program")
    with pytest.raises(OutsideSchemeError, match="cannot be started"):
        ScoringProgram(path)


PACKAGE = """
[project]
name = "outside"
version = "1"
[project.entry-points."zenfi.detectors"]
"""
SAME = "from detector.schemes.kinematic import Kinematic\nclass Same(Kinematic):\n    name = 'same'\n"


def package(folder: Path, points: str, code: str, module: str) -> Path:
    (folder / "src").mkdir(parents=True)
    (folder / "pyproject.toml").write_text(PACKAGE + points)
    (folder / "src" / f"{module}.py").write_text(code)
    return folder


def test_a_package_s_scheme_is_found_though_nobody_installed_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path])
    name, kind = scheme_in(package(tmp_path / "one", 'same = "outside_one:Same"', SAME, "outside_one"))
    assert (name, kind.__name__, kind.__module__) == ("same", "Same", "outside_one")
    assert kind.lesson(flight())


@pytest.mark.parametrize(
    ("points", "code", "says", "error"),
    [
        ("", "", "declares 0 detectors", OutsideSchemeError),
        ('a = "outside_two:A"\nb = "outside_two:B"', "", "declares 2 detectors, a, b", OutsideSchemeError),
        ('a = "outside_three:A"', "A = 3", "is no subclass", UnknownSchemeError),
        ('a = "outside_four:A"', "import absent_module", "cannot be imported", UnknownSchemeError),
    ],
)
def test_a_package_without_one_scheme_is_refused(
    points: str,
    code: str,
    says: str,
    error: type[Exception],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path])
    module = points.partition("outside_")[2].partition(":")[0]
    folder = package(tmp_path / "package", points, code, f"outside_{module}")
    with pytest.raises(error, match=says):
        scheme_in(folder)


def test_a_folder_that_is_no_package_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OutsideSchemeError, match=r"pyproject\.toml: has no"):
        scheme_in(tmp_path)
