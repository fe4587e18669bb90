"""``zenfi program run`` and ``replay``: what they print, and by which exit status."""

import json
import re
from pathlib import Path

import pytest

from dashboard.cli import main
from injector.kernel_study.results import StudyRun
from tests.injector.program.launched import compiled


def said(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    try:
        main(["program", *arguments])
        status = 0
    except SystemExit as ended:
        status = int(ended.code or 0)
    out, err = capsys.readouterr()
    return status, out, err


def test_runs_are_made_told_and_replayed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = str(tmp_path / "runs.jsonl")
    asked = ("--runs", "10", "--slots", "1", "--output", file)
    status, out, _ = said(capsys, "run", *asked, "--by", "register", "--", "echo", "-n", "hello")
    assert status == 0
    for word in ("benign", "sdc", "crash", "detected", "hang", "by register", "runs a second"):
        assert word in out
    status, out, _ = said(capsys, "run", *asked, "--json", "--", "echo", "-n", "hello")
    *runs, last = out.splitlines()
    assert len([StudyRun.model_validate_json(one) for one in runs]) == 10
    assert json.loads(last)["summary"]["injected"] == 10
    status, out, _ = said(capsys, "replay", file, "--slots", "1")
    assert (status, out) == (0, "replayed: 10 of 10 the same\n")
    changed = Path(file).read_text().replace('"result":"benign"', '"result":"hang"', 1)
    Path(file).write_text(changed)
    status, out, _ = said(capsys, "replay", file, "--slots", "1")
    assert status == 1
    assert "now benign" in out


def test_a_source_line_is_struck_and_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = """#include <stdio.h>
int main(void) {
    unsigned sum = 1;
    for (unsigned at = 0; at < 99; at++)
        sum = sum * 5 + at;
    printf("%u\\n", sum);
}
"""
    program, file = str(compiled(tmp_path, source, "sums", "-g")), str(tmp_path / "runs.jsonl")
    asked = ("--runs", "4", "--slots", "1", "--output", file, "--line", "sums.c:5", "--by", "line")
    status, out, _ = said(capsys, "run", *asked, "--", program)
    assert status == 0
    assert "by line" in out
    assert "sums.c:5" in out
    runs = Path(file).read_text()
    assert runs.count(f'"line":"{tmp_path}/sums.c:5"') == 4
    # What debug information says is no part of what is to be the same.
    Path(file).write_text(runs.replace(f'"line":"{tmp_path}/sums.c:5"', '"line":""'))
    assert said(capsys, "replay", file, "--slots", "1")[:2] == (0, "replayed: 4 of 4 the same\n")
    Path(file).write_text(re.sub('"result":"(benign|sdc|crash)"', '"result":"detected"', runs))
    status, out, _ = said(capsys, "replay", file, "--slots", "1")
    assert (status, out.count(f" at {tmp_path}/sums.c:5\n")) == (1, 4)


def test_a_file_says_what_the_options_say(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "hello.toml"
    file.write_text(
        'runs = 9\nseed = 3\n[program]\ncommand = ["echo", "-n", "hello"]\nmodule = "libc.so.6"\n'
    )
    asked = ("--json", "--slots", "1")
    status, by_file, _ = said(capsys, "run", "--spec", str(file), "--runs", "4", *asked)
    assert status == 0
    options = ("--runs", "4", "--seed", "3", "--module", "libc.so.6")
    _, by_options, _ = said(capsys, "run", *options, *asked, "--", "echo", "-n", "hello")
    assert by_file.splitlines()[:4] == by_options.splitlines()[:4]
    for more, problem in (
        (("--module", "x"), "--module: with --spec it is in the file"),
        (("--", "echo"), "COMMAND: with --spec it is in the file"),
        (("--fault", "bits=99"), "fault.bits: "),
    ):
        status, out, err = said(capsys, "run", "--spec", str(file), *more)
        assert (status, out, err.count("\n")) == (2, "", 1)
        assert problem in err


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (("run", "--", "no-such-program"), "no-such-program: no such program, or it cannot be executed"),
        (("run", "--address", "x", "--", "true"), "--address x: expected MODULE+0x10"),
        (("run", "--line", "main.c", "--", "true"), "line 'main.c': expected FILE:LINE"),
        (("run", "--env", "NO_SUCH", "--", "true"), "--env NO_SUCH: there is no such variable"),
        (("run", "--fault", "colour=red", "--", "true"), "colour"),
        (("run", "--runs", "0", "--", "true"), "--runs"),
        (("run",), "COMMAND"),
        (("run", "--spec", "/no/such/file.toml"), "/no/such/file.toml: No such file"),
        (("replay", "/no/such/file"), "/no/such/file"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    arguments: tuple[str, ...], problem: str, capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, err = said(capsys, *arguments)
    assert (status, out) == (2, "")
    assert problem in err.splitlines()[-1]
    assert err.startswith("zenfi: ")
