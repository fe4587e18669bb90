"""Stacks of tests: in a folder of their own, and gone afterwards, whatever the test did."""

import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from deploy.compose.control import ControlRequest, ProcessView, StackView, ask
from deploy.compose.daemon import StackStarted, start
from deploy.compose.folder import stack_folder
from deploy.compose.stack_file import Stack
from deploy.compose.system.process_tree import clear_marked
from tests.conftest import PATIENCE_S, wait_until

PROCESSES = Path(__file__).parents[2] / "fixtures" / "processes"


def fixture(name: str, *arguments: str) -> list[str]:
    """The command of a fixture process."""
    return [sys.executable, str(PROCESSES / f"{name}.py"), *arguments]


SLEEP = ["sleep", "1000"]
QUICKLY = {"first_s": 0.01, "most_s": 0.05}


class Laboratory:
    """Starts stacks and looks at them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.started: list[StackStarted] = []

    def stack(self, processes: Mapping[str, Any], name: str = "test", **more: Any) -> Stack:
        given = {one: {"backoff": QUICKLY, "folder": "/", **fields} for one, fields in processes.items()}
        return Stack.model_validate(
            {"name": name, "logs": str(self.folder / "logs" / name), "processes": given, **more}
        )

    def up(self, processes: Mapping[str, Any], *, attached: bool = False, **more: Any) -> StackView:
        started = start(self.stack(processes, **more), attached=attached)
        self.started.append(started)
        return started.view

    def ask(self, do: str, *names: str, stack: Stack | None = None) -> StackView:
        return ask(
            stack_folder("test"), ControlRequest.model_validate({"do": do, "names": names, "stack": stack})
        )

    def one(self, name: str) -> ProcessView:
        return next(one for one in self.ask("tell").processes if one.name == name)

    def until(self, name: str, condition: Callable[[ProcessView], bool]) -> ProcessView:
        """Wait for a state of a process."""
        wait_until(lambda: condition(self.one(name)), PATIENCE_S)
        return self.one(name)

    def phase(self, name: str, phase: str) -> ProcessView:
        return self.until(name, lambda one: one.phase == phase)

    def log(self, name: str = "x") -> list[str]:
        """The lines of a log without their times."""
        path = self.folder / "logs" / "test" / f"{name}.log"
        return [line.partition(" ")[2] for line in path.read_text().splitlines()]

    def down(self) -> None:
        self.ask("down")
        wait_until(lambda: self.started[-1].process.poll() is not None, PATIENCE_S)

    def clear(self) -> None:
        """Kill all that is left of the stacks."""
        for started in self.started:
            started.process.kill()
            started.process.wait()
            if started.process.stdin is not None:
                started.process.stdin.close()
            clear_marked(started.view.folder)


@pytest.fixture
def laboratory(monkeypatch: pytest.MonkeyPatch) -> Iterator[Laboratory]:
    # pytest's folders have paths too long for sockets.
    with tempfile.TemporaryDirectory() as name:
        monkeypatch.setenv("XDG_RUNTIME_DIR", name)
        made = Laboratory(Path(name))
        yield made
        made.clear()
