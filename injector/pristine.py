"""Processes that begin with the same memory, whenever, by whomever and from where they are started.

Where a process's stack and heap lie, and what is in them, depends on its environment, its arguments and the
kind of its output; on the keys that the kernel draws for it; even on which files lie beside the packages that
it imports. So all of that is fixed here (see also :mod:`injector.keys`), address randomisation is off and the
hash seed is 0.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Mapping
from pathlib import Path

from injector.keys import fix_keys

FIRST, AGAIN = "first", "again"
"""The first argument of the module that is begun: whether it was started again, see :func:`begin_again`."""

_ROOT = Path(__file__).parents[1]
_PATH = "ZENFI_PATH"
"""What PYTHONPATH is called until start.py runs: Python would list those folders at once."""

_ADDR_NO_RANDOMIZE = 0x0040000
_KEPT = ("HOME", "LD_LIBRARY_PATH", "PATH", "TMPDIR", "XDG_CACHE_HOME")
"""What the nodes' libraries need of the user's environment, beside numba's own settings."""

_libc = ctypes.CDLL(None, use_errno=True)


def environment(of: Mapping[str, str]) -> dict[str, str]:
    """The environment of such a process, made of that of the process that starts it."""
    kept = {name: of[name] for name in sorted(of) if name in _KEPT or name.startswith("NUMBA_")}
    path = [str(_ROOT), *filter(None, of.get("PYTHONPATH", "").split(os.pathsep))]
    return kept | {
        "LC_ALL": "C.UTF-8",
        # No flight draws a picture, and looking for OpenGL runs processes that answer sooner or later.
        "MUJOCO_GL": "disabled",
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONHASHSEED": "0",
        "PYTHONPATH": os.pathsep.join(dict.fromkeys(path)),
        # The buffers of a terminal and a pipe have different sizes.
        "PYTHONUNBUFFERED": "1",
    }


def command(module: str, *arguments: str) -> list[str]:
    """The command that runs ``module`` so, with :data:`FIRST` and the ``arguments``."""
    return [sys.executable, "-P", "-m", "injector.pristine", module, FIRST, *arguments]


def begin_again(module: str, *arguments: str) -> None:
    """Start this process again, with :data:`AGAIN`: what it had to compile lies ready now.

    What comes out of a cache lies elsewhere in memory than what has just been compiled.
    """
    whole = [sys.executable, "-P", "-m", "injector.pristine", module, AGAIN, *arguments]
    os.execv(sys.executable, whole)  # noqa: S606 - our own interpreter and module


def main() -> None:
    """Entry point: ``python -m injector.pristine MODULE FIRST|AGAIN ARGUMENT ...``."""
    surroundings = {_PATH if name == "PYTHONPATH" else name: value for name, value in os.environ.items()}
    _libc.personality(_libc.personality(0xFFFFFFFF) | _ADDR_NO_RANDOMIZE)
    fix_keys()
    start = str(Path(__file__).with_name("start.py"))
    # Without site (-S), which start.py runs itself once the folder of our packages is no longer listed.
    arguments = [sys.executable, "-P", "-S", start, *sys.argv[1:]]
    os.execve(sys.executable, arguments, surroundings)  # noqa: S606 - our own interpreter and script


if __name__ == "__main__":
    main()
