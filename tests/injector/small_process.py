"""Run the body of a test in an interpreter of its own, which has imported what it needs and nothing else.

What forks itself hundreds of times pays for all the memory of the process: in one that runs the whole test
suite, with simulators and web frameworks in it, a hundred times as much as here.
"""

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def in_small_process(body: Callable[..., None], folder: Path, *texts: str) -> None:
    """Call ``body``, a function of a module, with ``folder`` and ``texts``; fail with what it says if so."""
    if shutil.which("cc") is None:
        pytest.skip("no C compiler (cc) on this machine")
    code = (
        "import sys\nfrom pathlib import Path\n"
        f"from {body.__module__} import {body.__name__}\n"
        f"{body.__name__}(Path(sys.argv[1]), *sys.argv[2:])"
    )
    done = subprocess.run(
        [sys.executable, "-X", "faulthandler", "-c", code, str(folder), *texts],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
