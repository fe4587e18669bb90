"""The ``zenfi`` command as people and programs meet it.

``zenfi`` runs it in this process, without the seconds that an interpreter takes to start. ``ZENFI`` is for
tests of the process itself: signals, what it leaves behind, what its children write.
"""

import contextlib
import io
import sys
from dataclasses import dataclass
from pathlib import Path

from dashboard.cli import main

ZENFI = str(Path(sys.executable).parent / "zenfi")


@dataclass(frozen=True)
class Answer:
    """What the command printed, and how it ended."""

    returncode: int
    stdout: str
    stderr: str


def zenfi(*arguments: object) -> Answer:
    """The answer to ``zenfi`` with these arguments."""
    out, err, status = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main([str(one) for one in arguments])
        except SystemExit as end:
            status = int(end.code or 0)
    return Answer(status, out.getvalue(), err.getvalue())


def refusal(*arguments: object) -> str:
    """The one clear line with which bad input is refused, with status 2 and nothing else printed."""
    answer = zenfi(*arguments)
    assert (answer.returncode, answer.stdout) == (2, "")
    assert answer.stderr.startswith("zenfi: ")
    assert answer.stderr.count("\n") == 1
    return answer.stderr.removeprefix("zenfi: ").removesuffix("\n")


def not_ours(folder: Path) -> Path:
    """A folder with packages that are called like ours: somebody's project, or another checkout."""
    for name in ("services", "deploy", "injector", "sim", "detector", "dashboard"):
        (folder / name).mkdir(parents=True)
        (folder / name / "__init__.py").write_text("raise SystemExit('not ours')\n")
    return folder
