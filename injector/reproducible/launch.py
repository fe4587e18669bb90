"""Processes that begin with the same memory, whenever, by whomever and from where they are started.

Where a process's stack and heap lie, and what is in them, depends on its environment, its arguments and the
kind of its output; on limits, signals and processors that it was given; on the keys that the kernel draws for
it; even on which files lie beside the packages that it imports. So all of that is fixed here (see also
:mod:`injector.reproducible.fixed_entropy`), address randomisation is off and the hash seed is 0.
"""

from __future__ import annotations

import filecmp
import importlib.util
import os
import resource
import signal
import site
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from injector.reproducible import compiled_code
from injector.reproducible.bootstrap import STANDARD, give_back_standard_streams
from injector.reproducible.compiled_code import ROOT
from injector.reproducible.fixed_entropy import fix_keys
from injector.reproducible.forked_question import answered_by_a_fork
from services.system.libc import turn_address_randomisation_off
from services.system.process_stat import CLOCK_TICKS_PER_S, process_stat

_PATH = "ZENFI_PATH"
"""What PYTHONPATH is called until bootstrap.py runs: Python would list those folders at once."""

_COMPILED = "ZENFI_COMPILED"
"""Where compiled code is: for :func:`main`, which passes a descriptor on in its place."""

_ARGUMENTS_AT = 4
"""Where, in the command of such a process, the module stands that it runs."""

_PREPARED, _SECOND = 109, 110
"""Descriptors that are open in a process that was started again: before it compiled, and after it had.

The kernel knows them, our memory does not.
"""

_PROCESSORS = 116
"""Descriptor of a file that lists the processors that this process may use."""

_STACK_BYTES = 8 << 20
"""Soft limit of the stack, by which the kernel places what is mapped."""

_CONSTANT = {
    "HOME": "/nonexistent",
    "LC_ALL": "C.UTF-8",
    # No flight draws a picture, and looking for OpenGL runs processes that answer sooner or later.
    "MUJOCO_GL": "disabled",
    "NUMBA_CACHE_DIR": compiled_code.PATH,
    # By default as many as this process may use.
    "NUMBA_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "PATH": "/usr/local/bin:/usr/bin:/bin",
    "PYTHONHASHSEED": "0",
    # The buffers of a terminal and a pipe have different sizes.
    "PYTHONUNBUFFERED": "1",
}


def environment(of: Mapping[str, str], compiled: str) -> dict[str, str]:
    """The environment of such a process, made of that of the process that starts it.

    Of the user's it has no more than what names the libraries and packages of an installation, and
    numba's settings. ``compiled`` names the process's folder of compiled code.
    """
    named = filter(None, of.get("PYTHONPATH", "").split(os.pathsep))
    path = [*_own_folder(), *map(os.path.abspath, named)]
    kept = {name: value for name, value in of.items() if name == "LD_LIBRARY_PATH" or _of_numba(name)}
    user = {"PYTHONUSERBASE": site.getuserbase()} if _needs_user_site() else {"PYTHONNOUSERSITE": "1"}
    whole = (
        kept
        | _CONSTANT
        | user
        | {
            "PYTHONPATH": os.pathsep.join(dict.fromkeys(path)),
            _COMPILED: str(compiled_code.parent_folder(of) / compiled),
        }
    )
    return dict(sorted(whole.items()))


def _of_numba(name: str) -> bool:
    return name.startswith("NUMBA_")


def _needs_user_site() -> bool:
    """Whether what we need was installed for this user alone."""
    if not site.ENABLE_USER_SITE:
        return False
    numpy = importlib.util.find_spec("numpy")
    return numpy is not None and Path(str(numpy.origin)).is_relative_to(site.getusersitepackages())


def _own_folder() -> list[str]:
    """The folder of our packages, unless Python looks there anyway.

    In PYTHONPATH, site-packages would come before the standard library, and for every other Python too.
    """
    searched = [*site.getsitepackages(), site.getusersitepackages()]
    return [] if str(ROOT) in searched else [str(ROOT)]


def command(module: str, *arguments: str) -> list[str]:
    """The command that runs ``module`` so."""
    return [_interpreter(), "-P", "-m", "injector.reproducible.launch", module, *arguments]


def _interpreter() -> str:
    """The path of this Python, by the same one of its names whichever it was started by.

    A process keeps its path in memory, and so do many objects of the interpreter.
    """
    own = Path(sys.executable)
    names = (own.parent.resolve() / name for name in ("python3", "python"))
    # An environment may have links or copies.
    return str(next((one for one in names if one.exists() and filecmp.cmp(one, own)), own))


def begin_again_to_compile(stdin: int = 0) -> None:
    """Start this process again, as it was begun, if it is about to compile and Python had to.

    What is compiled depends a little on where things lie in memory. To be called once all is imported;
    ``stdin`` is where what was its standard input is now.
    """
    if answered_by_a_fork(
        lambda: (
            compiled_code.is_unfinished()
            and not _is_open(_PREPARED)
            and not _is_open(_SECOND)
            and _wrote_byte_code(os.getppid())
        )
    ):
        compiled_code.leave()
        _begin_again(_PREPARED, stdin)


def begin_again_if(compiled: bool, stdin: int = 0) -> None:
    """Start this process again, as it was begun, if numba had to compile what it imported, or Python had.

    What comes out of a cache lies elsewhere in memory than what has just been compiled. That goes once, or
    for as long as somebody changes our sources meanwhile, so that there is a folder to be filled again. Who
    was started again has the same memory as who was not, so a fork looks which of them this is. Who stays has
    its standard streams from here on. ``stdin`` is where what was its standard input is now.
    """
    if answered_by_a_fork(
        lambda: (
            compiled_code.is_unfinished()
            or (not _is_open(_SECOND) and (compiled or _wrote_byte_code(os.getppid())))
        )
    ):
        if compiled_code.is_unfinished():
            compiled_code.finish()
        _begin_again(_SECOND, stdin)
    answered_by_a_fork(_restrict_parent_to_its_processors)
    os.close(_PROCESSORS)
    give_back_standard_streams()
    os.closerange(_PREPARED, _SECOND + 1)


def _begin_again(mark: int, stdin: int) -> None:
    """With the arguments and the environment that it was begun with, in their order, and ``mark`` open."""
    answered_by_a_fork(_restrict_parent_to_its_processors)
    give_back_standard_streams()
    os.dup2(stdin, 0)
    os.dup2(0, mark)
    arguments = Path("/proc/self/cmdline").read_bytes().split(b"\0")[_ARGUMENTS_AT:-1]
    entries = [one.partition(b"=") for one in Path("/proc/self/environ").read_bytes().split(b"\0") if one]
    surroundings = {b"PYTHONPATH" if name == _PATH.encode() else name: value for name, _, value in entries}
    surroundings[_COMPILED.encode()] = os.fsencode(compiled_code.folder().parent)
    whole = [*command(os.fsdecode(arguments[0])), *map(os.fsdecode, arguments[1:])]
    os.execve(whole[0], whole, surroundings)  # noqa: S606 - our own interpreter and module


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
    numba = {name: value for name, value in surroundings.items() if _of_numba(name)}
    compiled_code.open_folder(Path(surroundings.pop(_COMPILED)), numba)
    turn_address_randomisation_off()
    fix_keys()
    _use_default_signals()
    _use_all_processors()
    hard = resource.getrlimit(resource.RLIMIT_STACK)[1]
    most = _STACK_BYTES if hard == resource.RLIM_INFINITY else min(hard, _STACK_BYTES)
    resource.setrlimit(resource.RLIMIT_STACK, (most, hard))
    _put_aside_standard_streams()
    os.chdir("/")  # compilers look where they are
    start = str(Path(__file__).with_name("bootstrap.py"))
    # Without site (-S), which bootstrap.py runs itself once the folder of our packages is no longer listed.
    arguments = [sys.executable, "-P", "-S", start, *sys.argv[1:]]
    os.execve(sys.executable, arguments, surroundings)  # noqa: S606 - our own interpreter and script


def _use_default_signals() -> None:
    """Python looks which signals it was told to ignore, as by nohup(1)."""
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    for number in signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP}:
        signal.signal(number, signal.SIG_DFL)


def _use_all_processors() -> None:
    """Libraries read what the kernel tells about the processors that a process may use, which is text."""
    listed = os.memfd_create("processors")
    os.write(listed, " ".join(map(str, os.sched_getaffinity(0))).encode())
    os.dup2(listed, _PROCESSORS)
    os.close(listed)
    os.sched_setaffinity(0, range(os.cpu_count() or 1))


def _restrict_parent_to_its_processors() -> bool:
    os.lseek(_PROCESSORS, 0, os.SEEK_SET)
    os.sched_setaffinity(os.getppid(), map(int, os.read(_PROCESSORS, 1 << 16).split()))
    return True


def _put_aside_standard_streams() -> None:
    """Imports see the null device in their place: Python and others look what kind of files they are."""
    nothing = os.open(os.devnull, os.O_RDWR)
    for descriptor, aside in enumerate(STANDARD):
        os.dup2(descriptor, aside)
        os.dup2(nothing, descriptor)
    os.close(nothing)


if __name__ == "__main__":
    main()
