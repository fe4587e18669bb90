"""Processes that begin with the same memory, whenever, by whomever and from where they are started.

Where a process's stack and heap lie, and what is in them, depends on its environment, its arguments and the
kind of its output; on the keys that the kernel draws for it; even on which files lie beside the packages that
it imports. So all of that is fixed here (see also :mod:`injector.reproducible.fixed_entropy`), address
randomisation is off and the hash seed is 0.
"""

from __future__ import annotations

import os
import site
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from injector.reproducible.fixed_entropy import fix_keys
from injector.reproducible.forked_question import answered_by_a_fork
from services.system.libc import libc
from services.system.process_stat import CLOCK_TICKS_PER_S, process_stat

_ROOT = Path(__file__).parents[2]
_PATH = "ZENFI_PATH"
"""What PYTHONPATH is called until bootstrap.py runs: Python would list those folders at once."""

_ADDR_NO_RANDOMIZE = 0x0040000
_ARGUMENTS_AT = 4
"""Where, in the command of such a process, the module stands that it runs."""

_SECOND = 110
"""A descriptor that is open in a process that was started again. The kernel knows it, our memory does not."""

_KEPT = ("HOME", "LD_LIBRARY_PATH", "PATH", "TMPDIR", "XDG_CACHE_HOME")
"""What the nodes' libraries need of the user's environment, beside numba's own settings."""


def environment(of: Mapping[str, str]) -> dict[str, str]:
    """The environment of such a process, made of that of the process that starts it."""
    kept = {name: of[name] for name in sorted(of) if name in _KEPT or name.startswith("NUMBA_")}
    path = [*_own_folder(), *filter(None, of.get("PYTHONPATH", "").split(os.pathsep))]
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


def _own_folder() -> list[str]:
    """The folder of our packages, unless Python looks there anyway.

    In PYTHONPATH, site-packages would come before the standard library, and for every other Python too.
    """
    searched = [*site.getsitepackages(), site.getusersitepackages()]
    return [] if str(_ROOT) in searched else [str(_ROOT)]


def command(module: str, *arguments: str) -> list[str]:
    """The command that runs ``module`` so."""
    return [sys.executable, "-P", "-m", "injector.reproducible.launch", module, *arguments]


def begin_again_if(compiled: bool, stdin: int = 0) -> None:
    """Start this process again, as it was begun, if numba had to compile what it imported, or Python had.

    What comes out of a cache lies elsewhere in memory than what has just been compiled. That goes once; who
    was started again has the same memory as who was not, so a fork looks which of them this is. ``stdin`` is
    where what was its standard input is now.
    """
    if answered_by_a_fork(lambda: not _is_open(_SECOND) and (compiled or _wrote_byte_code(os.getppid()))):
        os.dup2(stdin, 0)
        os.dup2(0, _SECOND)
        _begin_again()
    os.closerange(_SECOND, _SECOND + 1)


def _begin_again() -> None:
    """With the arguments and the environment that it was begun with, in their order."""
    arguments = Path("/proc/self/cmdline").read_bytes().split(b"\0")[_ARGUMENTS_AT:-1]
    entries = [one.partition(b"=") for one in Path("/proc/self/environ").read_bytes().split(b"\0") if one]
    surroundings = {b"PYTHONPATH" if name == _PATH.encode() else name: value for name, _, value in entries}
    whole = [*command(os.fsdecode(arguments[0])), *map(os.fsdecode, arguments[1:])]
    os.execve(sys.executable, whole, surroundings)  # noqa: S606 - our own interpreter and module


def _is_open(descriptor: int) -> bool:
    return Path(f"/proc/self/fd/{descriptor}").exists()


def _wrote_byte_code(process: int) -> bool:
    """Whether byte code that we use has been written since a process began, or just before."""
    began_ticks = process_stat(process).start_ticks
    age_s = time.clock_gettime(time.CLOCK_BOOTTIME) - began_ticks / CLOCK_TICKS_PER_S
    files = [getattr(module, "__cached__", None) for module in list(sys.modules.values())]
    newest_s = max(Path(file).stat().st_mtime for file in files if file and Path(file).exists())
    return newest_s > time.time() - age_s - 1.0


def main() -> None:
    """Entry point: ``python -m injector.reproducible.launch MODULE ARGUMENT ...``."""
    surroundings = {_PATH if name == "PYTHONPATH" else name: value for name, value in os.environ.items()}
    libc.personality(libc.personality(0xFFFFFFFF) | _ADDR_NO_RANDOMIZE)
    fix_keys()
    start = str(Path(__file__).with_name("bootstrap.py"))
    # Without site (-S), which bootstrap.py runs itself once the folder of our packages is no longer listed.
    arguments = [sys.executable, "-P", "-S", start, *sys.argv[1:]]
    os.execve(sys.executable, arguments, surroundings)  # noqa: S606 - our own interpreter and script


if __name__ == "__main__":
    main()
