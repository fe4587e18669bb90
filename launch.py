"""Set up and run, on a machine that has Python 3.11 or newer with venv and pip and nothing else.

python3 launch.py demo       makes .venv, installs, flies a small campaign
python3 launch.py test       makes .venv, installs what tests need, runs every check and the gate's tests
python3 launch.py unit       the tests that start no process: less than a minute
python3 launch.py soak       the long tests that are not in the gate
python3 launch.py docs       makes the API reference in build/api
python3 launch.py mutants    tries small wrong changes of the code, each of which a test must notice
python3 launch.py lock       installs the newest versions for all jobs and writes them to constraints.txt
python3 launch.py dependencies     writes docs/dependencies.md: reasons, versions, licences
python3 launch.py vulnerabilities  asks the package index for known vulnerabilities of the locked versions
python3 launch.py release    builds source archive, wheel and bill of materials in build/release

What follows is passed on: to pytest after test, unit and soak, else to the command itself.

python3 launch.py --locked JOB   installs the versions of constraints.txt and no others
"""

import hashlib
import os
import signal
import subprocess
import sys
import tempfile
import venv
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent
ENVIRONMENT = ROOT / ".venv"
BIN = ENVIRONMENT / "bin"
LOCK = ROOT / "constraints.txt"

DEPENDENCIES = ["python", "-m", "release.dependencies"]
JOBS = {
    "demo": [["zenfi", "demo"]],
    "test": [
        ["ruff", "check", "."],
        ["ruff", "format", "--check", "."],
        ["mypy"],
        ["lint-imports"],
        ["pytest", "-m", "not soak"],
    ],
    "unit": [["pytest", "-m", "unit"]],
    "soak": [["pytest", "-m", "soak"]],
    "mutants": [["python", "-m", "tests.mutants.run"]],
    "docs": [["python", "docs/api.py", "build/api"]],
    "dependencies": [DEPENDENCIES],
    "vulnerabilities": [["python", "-m", "release.vulnerabilities"]],
    "release": [["python", "-m", "release.build"]],
}
"""The commands of each job. They run side by side; the last one, which is given further arguments, is shown
as it goes, the others whole when all have ended."""

PARTS = (
    ["tests/dashboard", "--ignore=tests/dashboard/web"],
    ["tests/dashboard/web", "tests/injector"],
    ["tests/deploy/mission", "tests/deploy/pairing"],
    [
        "--ignore=tests/dashboard",
        "--ignore=tests/injector",
        "--ignore=tests/deploy/mission",
        "--ignore=tests/deploy/pairing",
    ],
)
"""What is added for processes to run all of the gate's tests side by side, each for about as long.

Many tests wait for what they started: as many processes as processors would leave much of the time unused.
"""


def install(what: str, *, locked: bool) -> None:
    """Install ``what`` into the environment, unless that was done for this pyproject.toml and this lock."""
    stamp = ENVIRONMENT / f"installed-{what.strip('.[]') or 'zenfi'}"
    sources = (ROOT / "pyproject.toml", *([LOCK] if locked else []))
    wanted = hashlib.sha256(b"".join(one.read_bytes() for one in sources)).hexdigest()
    if stamp.exists() and stamp.read_text() == wanted:
        return
    if not (BIN / "pip").exists():
        venv.create(ENVIRONMENT, with_pip=True)
    constraints = ["--constraint", str(LOCK)] if locked else []
    pip("install", "--quiet", "--editable", what, *constraints)
    stamp.write_text(wanted)


def pip(*arguments: str) -> str:
    """Run the environment's pip; what it printed."""
    command = [str(BIN / "pip"), "--disable-pip-version-check", *arguments]
    return subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True).stdout


def lock() -> int:
    """Install the newest versions and write them to the lock and the page of dependencies.

    Versions are without the builds of one index (``+cpu``).
    """
    install(".[test]", locked=False)
    pip("install", "--quiet", "--upgrade", "--upgrade-strategy", "eager", "--editable", ".[test]")
    installed = pip("freeze", "--all", "--exclude", "pip", "--exclude-editable").splitlines()
    lines = ["# The versions of launch.py --locked; written by: python3 launch.py lock", *installed]
    LOCK.write_text("".join(f"{one.partition('+')[0]}\n" for one in lines))
    return run([DEPENDENCIES])


def run(commands: Sequence[Sequence[str]]) -> int:
    """Run commands side by side until all have ended; the exit status of the first one listed that fails."""
    environment = {**os.environ, "PATH": f"{BIN}{os.pathsep}{os.environ['PATH']}"}
    with tempfile.TemporaryDirectory() as folder:
        outputs = [Path(folder) / str(number) for number in range(len(commands) - 1)]
        running = []
        for command, output in zip(commands, outputs, strict=False):
            with output.open("wb") as file:
                running.append(start(command, environment, file.fileno()))
        running.append(start(commands[-1], environment, None))
        try:
            statuses = [one.wait() for one in reversed(running)][::-1]
        except BaseException:
            for one in running:
                one.terminate()
            for one in running:
                one.wait()
            raise
        for command, output, status in zip(commands, outputs, statuses, strict=False):
            verdict = f"failed with {status}" if status else "passed"
            sys.stdout.write(f"\n--- {' '.join(command)}: {verdict}\n{output.read_text(errors='replace')}")
    return next((status for status in statuses if status), 0)


def start(
    command: Sequence[str], environment: dict[str, str], output: "int | None"
) -> "subprocess.Popen[bytes]":
    """A command of the environment's, writing to a descriptor, or where this one writes."""
    return subprocess.Popen(
        [str(BIN / command[0]), *command[1:]],
        cwd=ROOT,
        env=environment,
        stdout=output,
        stderr=subprocess.STDOUT if output is not None else None,
    )


def main() -> int:
    """Run the named job; the exit status of its first command that fails."""
    if sys.version_info < (3, 11):
        sys.stderr.write(f"launch.py: needs Python 3.11 or newer, this is {sys.version.split()[0]}\n")
        return 2
    locked = sys.argv[1:2] == ["--locked"]
    given = sys.argv[2 if locked else 1 :]
    job, more = "".join(given[:1]), given[1:]
    if job == "lock" and not locked and not more:
        return lock()
    if job not in JOBS:
        sys.stderr.write(f"usage: python3 launch.py [--locked] {'|'.join(JOBS)}, or lock\n")
        return 2
    install({"demo": ".", "docs": ".[docs]"}.get(job, ".[test]"), locked=locked)
    return run(commands(job, more))


def commands(job: str, more: Sequence[str]) -> list[list[str]]:
    """The commands of a job; tests that are asked for by further arguments are not divided."""
    *checks, last = JOBS[job]
    if job == "test" and not more:
        return [*checks, *([*last, *part] for part in PARTS)]
    return [*checks, [*last, *more]]


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
