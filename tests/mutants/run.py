"""Apply one wrong change at a time to a copy of the tree and see whether the named tests fail.

python3 launch.py mutants             all of them
python3 launch.py mutants horizon:    those whose name contains a word

Prints a line for each change (killed or survived) and a summary. The exit status is 0 if at least 95 % are
killed, 1 if fewer are, 2 if a change does not fit the code or the tests fail without any.
"""

import argparse
import os
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from services.system.lifeline import die_with_parent
from tests.mutants.changes import MUTANTS, Mutant

ROOT = Path(__file__).parents[2]
LEFT_OUT = shutil.ignore_patterns(
    ".git",
    ".venv",
    "__pycache__",
    ".*_cache",
    ".import_linter*",
    "*.egg-info",
    ".hypothesis",
    "build",
    "dist",
)
LIMIT_S = 300.0
"""A change that makes its tests hang for so long is noticed."""

PLUGINS = ("cacheprovider", "schemathesis")
OPTIONS = ("-x", "-q", "--tb=short", *(f"-pno:{one}" for one in PLUGINS))
"""Without what is not needed to run a quick test: to import it takes longer than the tests themselves."""

ENOUGH = 0.95

Verdict = str


class MisfitError(Exception):
    """A change whose old text is not in its file exactly once, or tests that fail without any change."""


@dataclass(slots=True)
class Tree:
    """A copy of the tree for one change at a time."""

    folder: Path
    running: "subprocess.Popen[str] | None" = None

    @classmethod
    def copy(cls, of: Path, to: Path) -> "Tree":
        """Copy what tests need; compiled files are left out."""
        shutil.copytree(of, to, ignore=LEFT_OUT, symlinks=True)
        return cls(to)

    def apply(self, mutant: Mutant) -> None:
        """Make the change.

        :raises MisfitError: if its old text is not there exactly once.
        """
        file = self.folder / mutant.path
        text = file.read_text()
        found = text.count(mutant.old)
        if found != 1:
            message = f"{mutant.name}: its old text is in {mutant.path} {found} times"
            raise MisfitError(message)
        file.write_text(text.replace(mutant.old, mutant.new))

    def restore(self, mutant: Mutant, origin: Path) -> None:
        """Put the file back as it is in ``origin``."""
        (self.folder / mutant.path).write_text((origin / mutant.path).read_text())

    def _without_fixtures(self, tests: Sequence[str]) -> tuple[str, ...]:
        """What leaves out the shared fixtures, where no test asks for one, a fork server or a stack."""
        named = [self.folder / test.partition("::")[0] for test in tests]
        files = [file for one in named for file in ([one] if one.is_file() else one.rglob("test_*.py"))]
        asked = any(
            word in file.read_text()
            for file in files
            for word in ("usefixtures", "ForkServer", "store: Store", "Laboratory")
        )
        return () if asked else ("--noconftest",)

    def end(self) -> None:
        """Kill the tests that run, with all that they have started."""
        if self.running is not None and self.running.poll() is None:
            os.killpg(self.running.pid, signal.SIGKILL)

    def test(self, tests: Sequence[str], *, compiled_anew: bool, limit_s: float) -> tuple[Verdict, str]:
        """Run tests: passed, failed or late, and what they printed.

        Nothing compiled is kept of Python, nor of numba where a compiled function was changed: it does not
        notice that a function in another file which it calls is another one.
        """
        with tempfile.TemporaryDirectory(prefix="zenfi-numba-") as caches, ExitStack() as stack:
            kept = caches if compiled_anew else str(self.folder / ".numba")
            environment = {
                **os.environ,
                "CI": "1",  # has hypothesis draw the same each time, and set no deadline
                "NUMBA_CACHE_DIR": kept,
                "PYTHONDONTWRITEBYTECODE": "1",
                "PYTHONPATH": str(self.folder),
            }
            parent = os.getpid()
            process = self.running = stack.enter_context(
                subprocess.Popen(
                    [sys.executable, "-m", "pytest", *OPTIONS, *self._without_fixtures(tests), *tests],
                    cwd=self.folder,
                    env=environment,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    text=True,
                    start_new_session=True,
                    preexec_fn=lambda: die_with_parent(parent),  # noqa: PLW1509 - one system call
                )
            )
            try:
                said, _ = process.communicate(timeout=limit_s)
            except subprocess.TimeoutExpired:
                self.end()
                said, _ = process.communicate()
                return "late", said
        return ("passed" if process.returncode == 0 else "failed"), said


def compiles(root: Path, mutant: Mutant) -> bool:
    """Whether numba compiles functions of the changed file."""
    return "njit" in (root / mutant.path).read_text()


def run(
    mutants: Sequence[Mutant], root: Path = ROOT, jobs: int = 1, limit_s: float = LIMIT_S
) -> dict[str, bool]:
    """Whether each change is killed, by name; prints as they come.

    :raises MisfitError: if one does not fit, or tests fail without a change.
    """
    with tempfile.TemporaryDirectory(prefix="zenfi-mutants-") as scratch:
        trees: queue.SimpleQueue[Tree] = queue.SimpleQueue()
        copies = [Tree.copy(root, Path(scratch) / str(number)) for number in range(jobs)]
        for mutant in mutants:  # before anything takes time
            copies[0].apply(mutant)
            copies[0].restore(mutant, root)
        tests = sorted({test for mutant in mutants for test in mutant.tests})
        verdict, said = copies[0].test(tests, compiled_anew=False, limit_s=max(limit_s, 10 * LIMIT_S))
        if verdict != "passed":
            raise MisfitError(f"the tests fail without any change\n{said}")
        for tree in copies:
            trees.put(tree)

        def one(mutant: Mutant) -> bool:
            tree, begun = trees.get(), time.monotonic()
            try:
                tree.apply(mutant)
                verdict, _ = tree.test(mutant.tests, compiled_anew=compiles(root, mutant), limit_s=limit_s)
            finally:
                tree.restore(mutant, root)
                trees.put(tree)
            fate = {"passed": "SURVIVED", "failed": "killed", "late": "killed (time limit)"}[verdict]
            print(f"{fate:20} {time.monotonic() - begun:5.1f} s  {mutant.name}", flush=True)
            return verdict != "passed"

        pool = ThreadPoolExecutor(jobs)
        try:
            return dict(zip((mutant.name for mutant in mutants), pool.map(one, mutants), strict=True))
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            for tree in copies:
                tree.end()
            pool.shutdown()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run those that are asked for; the exit status."""
    parser = argparse.ArgumentParser(prog="launch.py mutants", description=__doc__.partition("\n")[0])
    parser.add_argument("words", nargs="*", help="only changes whose name contains one of these")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="how many at a time")
    asked = parser.parse_args(arguments)
    chosen = [one for one in MUTANTS if not asked.words or any(word in one.name for word in asked.words)]
    if not chosen:
        parser.error("no change has such a name")
    # Children die with the thread that started them, and the copies are removed on the way out.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    try:
        killed = run(chosen, jobs=max(1, min(asked.jobs, len(chosen))))
    except MisfitError as error:
        print(error, file=sys.stderr)
        return 2
    survivors = [name for name, dead in killed.items() if not dead]
    print(
        f"{len(killed) - len(survivors)} of {len(killed)} killed",
        *(f"survived: {one}" for one in survivors),
        sep="\n",
    )
    return 0 if len(survivors) <= (1 - ENOUGH) * len(killed) else 1


if __name__ == "__main__":
    sys.exit(main())
