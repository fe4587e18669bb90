"""A C++ node of somebody else's in a stack: announced by the wrapper, found by its name, struck."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from deploy.compose.folder import StackError
from deploy.compose.wrapper import NotAnnouncedError, claim_of, run_announced, verify
from services.bus.announce import Announcement, announcement
from tests.conftest import PATIENCE_S, alive, wait_until
from tests.deploy.compose.conftest import Laboratory
from tests.injector.cpp_program import mapper

__all__ = ["mapper"]


def announced(program: Path) -> dict[str, object]:
    command = ["zenfi", "announce", "--name", "mapper", "--", str(program)]
    return {"command": command, "ready": {"announces": "mapper", "within_s": PATIENCE_S}, "restart": "never"}


@contextmanager
def sleeper() -> Iterator[int]:
    with subprocess.Popen(["/bin/sleep", "1000"]) as process:
        try:
            yield process.pid
        finally:
            process.kill()


@pytest.mark.soak
def test_it_is_struck_by_its_name_and_dies_with_its_wrapper(mapper: Path, laboratory: Laboratory) -> None:
    laboratory.up({"x": announced(mapper)})
    laboratory.phase("x", "ready")
    stack = laboratory.ask("tell")
    claim = claim_of(stack, "mapper")
    assert Path(f"/proc/{claim.pid}/exe").readlink() == mapper
    verify(stack, claim)
    symbol = "grid::insert(double, int)"
    zenfi = str(Path(sys.executable).parent / "zenfi")
    command = [zenfi, "inject", "--node", "mapper", "--symbol", symbol, "--seed", "3", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["injection"]["node"] == "mapper"
    assert told["injection"]["pid"] == claim.pid
    assert told["injection"]["instruction"]
    assert told["function"] == symbol

    with sleeper() as other:
        foreign = replace(announcement("other", other), executable=inode("/bin/sleep"))
        with pytest.raises(NotAnnouncedError, match="was not started by stack test"):
            verify(stack, foreign)
    for lie in (
        replace(claim, executable=(1, 1)),
        replace(claim, executable=None),
        replace(claim, start_ticks=claim.start_ticks + 1),
        replace(claim, boot_id="another"),
    ):
        with pytest.raises(NotAnnouncedError, match="mapper: process"):
            verify(stack, lie)
    with pytest.raises(NotAnnouncedError, match=r"no node .maper. is announced in stack test; .*: mapper"):
        claim_of(stack, "maper")
    os.kill(laboratory.one("x").pid or 0, 9)
    wait_until(lambda: not alive(claim.pid), PATIENCE_S)


def test_its_end_is_the_wrappers_end_and_signals_reach_it(laboratory: Laboratory, tmp_path: Path) -> None:
    script = tmp_path / "script.sh"
    script.write_text("trap 'echo asked; exit 7' TERM\necho here\nwhile :; do sleep 0.1; done\n")
    command = ["zenfi", "announce", "--", "sh", str(script)]
    ready = {"announces": "sh", "within_s": PATIENCE_S}
    laboratory.up({"x": {"command": command, "ready": ready, "restart": "never"}})
    laboratory.phase("x", "ready")
    wait_until(lambda: "here" in laboratory.log())
    os.kill(laboratory.one("x").pid or 0, 15)
    assert "7" in laboratory.phase("x", "failed").reason
    assert "asked" in laboratory.log()


def test_outside_a_stack_it_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ZENFI_STACK", raising=False)
    with pytest.raises(StackError, match="the command of a process in a stack file"):
        run_announced("x", ["true"])


def test_an_announcement_is_read_as_it_was_written() -> None:
    own = announcement("x")
    for claim in (own, replace(own, executable=(64769, 12345))):
        assert Announcement.parse(claim.key) == claim


def inode(path: str) -> tuple[int, int]:
    file = Path(path).stat()
    return file.st_dev, file.st_ino
