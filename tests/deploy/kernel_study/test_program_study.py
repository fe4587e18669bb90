"""The study of a program in a file: what it says, what it finds, and what is refused in one line."""

from pathlib import Path

import pytest

from deploy.errors import BadSpecError
from deploy.kernel_study.program_study import (
    ENVIRONMENT,
    ProgramStudySpec,
    changed_study,
    load_program_study,
)

WHOLE = """
runs = 20
seed = 7
fault = { bits = 2, register_class = "gpr" }

[program]
command = ["./show.sh", "data"]
inputs = ["data"]
compare = ["out"]
ignore = ["stderr"]
detected = [3]
tolerance = 1e-6
module = "libc.so.6"
address = 0x4a20
environment = { LEVEL = "9" }
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    script = tmp_path / "show.sh"
    script.write_text("#!/bin/sh\ncat data > out\n")
    script.chmod(0o755)
    (tmp_path / "data").write_text("1 2 3")
    return tmp_path


def written(folder: Path, text: str) -> Path:
    file = folder / "study.toml"
    file.write_text(text)
    return file


def test_what_a_file_says_is_the_study(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = written(folder, WHOLE)
    monkeypatch.chdir("/")
    study = load_program_study(file)
    program = study.program
    assert (study.runs, study.seed, study.fault.bits, study.fault.register_class) == (20, 7, 2, "gpr")
    assert (program.executable, program.folder) == (str(folder / "show.sh"), str(folder))
    assert program.environment == {**ENVIRONMENT, "LEVEL": "9"}
    assert program.compared == ("stdout", "out")
    assert (program.module, program.address, program.tolerance) == ("libc.so.6", 0x4A20, 1e-6)
    assert ProgramStudySpec.model_validate_json(study.model_dump_json(exclude_unset=True)) == study


def test_numbers_and_fault_can_be_others(folder: Path) -> None:
    study = load_program_study(written(folder, WHOLE))
    more = changed_study(study, None, runs=50)
    assert more == study.model_copy(update={"runs": 50})
    other = changed_study(study, {"field": "exponent"})
    assert (other.fault.bits, other.fault.field, other.seed) == (1, "exponent", 7)
    drawn = changed_study(study, {"mask": "uniform"}, seed=1)
    assert changed_study(drawn, None) == drawn
    with pytest.raises(BadSpecError, match=r"runs: Input should be greater .* got 0"):
        changed_study(study, None, runs=0)


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("seed = 7", "sead = 7", "sead: Extra inputs are not permitted"),
        ("detected =", "detekted =", "program.detekted: Extra inputs are not permitted"),
        ("bits = 2", "colour = 2", "fault.colour: Extra inputs are not permitted"),
        ("bits = 2", "bits = 65", "fault.bits: "),
        ("bits = 2", 'target = "pid"', "fault.target: the study of a program chooses it"),
        ("bits = 2", 'histogram = "none.toml"', "none.toml: No such file"),
        ("runs = 20", "runs = 0", "runs: Input should be greater"),
        ("[program]", "[programme]", r"program: a table \[program\] with the command is needed"),
        ('["./show.sh", "data"]', "[]", "program.command: "),
        ('"./show.sh"', '"./none"', "./none: no such program"),
        ('inputs = ["data"]', 'inputs = ["none"]', "none: no such file"),
        ('["out"]', '["../out"]', "compare: ../out: expected a file in the run's own folder"),
        ("tolerance = 1e-6", 'tolerance = 1e-6\ncomparator = ["cmp"]', "tolerance and comparator both"),
        ('module = "libc.so.6"', "", "address: needs its module"),
        ("runs = 20", "runs = ", "not valid TOML"),
    ],
)
def test_what_is_none_is_named_with_the_file(folder: Path, old: str, new: str, problem: str) -> None:
    file = written(folder, WHOLE.replace(old, new, 1))
    with pytest.raises(BadSpecError, match=problem) as refused:
        load_program_study(file)
    assert str(refused.value).startswith(str(folder))
    assert "\n" not in str(refused.value)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(BadSpecError, match=r"none\.toml: No such file"):
        load_program_study(tmp_path / "none.toml")
