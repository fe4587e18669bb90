"""Set up and run, on a machine that has Python 3.11 or newer with venv and pip and nothing else.

python3 launch.py demo     makes .venv, installs, flies a small campaign
python3 launch.py test     makes .venv, installs what tests need, runs every check and test
"""

import hashlib
import os
import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent
ENVIRONMENT = ROOT / ".venv"
BIN = ENVIRONMENT / "bin"

STEPS = {
    "demo": [["zenfi", "demo"]],
    "test": [
        ["ruff", "check", "."],
        ["ruff", "format", "--check", "."],
        ["mypy"],
        ["lint-imports"],
        ["pytest"],
    ],
}


def install(what: str) -> None:
    """Install ``what`` into the environment, unless that was done for this pyproject.toml."""
    stamp = ENVIRONMENT / f"installed-{'test' if '[test]' in what else 'zenfi'}"
    wanted = hashlib.sha256((ROOT / "pyproject.toml").read_bytes()).hexdigest()
    if stamp.exists() and stamp.read_text() == wanted:
        return
    if not (BIN / "pip").exists():
        venv.create(ENVIRONMENT, with_pip=True)
    pip = [str(BIN / "pip"), "install", "--quiet", "--disable-pip-version-check", "--editable", what]
    subprocess.run(pip, cwd=ROOT, check=True)
    stamp.write_text(wanted)


def main() -> int:
    """Run the steps of the named job; the exit status of the first that fails."""
    if sys.version_info < (3, 11):
        sys.stderr.write(f"launch.py: needs Python 3.11 or newer, this is {sys.version.split()[0]}\n")
        return 2
    job = sys.argv[1] if len(sys.argv) > 1 else ""
    if job not in STEPS:
        sys.stderr.write(f"usage: python3 launch.py {'|'.join(STEPS)}\n")
        return 2
    install(".[test]" if job == "test" else ".")
    path = f"{BIN}{os.pathsep}{os.environ['PATH']}"
    for step in STEPS[job]:
        status = subprocess.run(
            [str(BIN / step[0]), *step[1:]], cwd=ROOT, env={**os.environ, "PATH": path}, check=False
        ).returncode
        if status:
            return status
    return 0


if __name__ == "__main__":
    sys.exit(main())
