"""Nodes begin with the same memory under all that users differ in, word by word."""

import os
import resource
import signal
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from deploy.mission.fork_server import ForkServer
from injector.reproducible.pid_namespace import CALLER
from services.system.process_stat import process_stat
from tests.conftest import descendants, wait_until
from tests.process_memory import Memory, different, load, memory, save

ROOT = Path(__file__).parents[3]
NOBODY = 65534
OF_A_USER = 40
"""Words with a user's number, and with how often small numbers are referred to. A shift is thousands."""
OPTIONAL = ("cffi", "colorama", "coverage", "cython", "scikits", "charset_normalizer", "yaml")
"""Packages that others of ours import if they are there."""
MORE = tuple(f"more_{number}{end}" for number in range(40) for end in ("", "-1.0.dist-info"))

FEW = 8
"""Words beyond the usual ones: on which processor it runs, and another digit of a number."""


def tell(file: str) -> None:
    """Write the memory of a fork server's process, from which all nodes are forked, to a file."""
    with closing(ForkServer()) as server:
        goes_on = [pid for pid, name in descendants(server.pid).items() if name == CALLER]
        pid = goes_on[0] if server.fixed_pids else server.pid
        wait_until(lambda: process_stat(pid).state == "S")
        save(memory(pid, stack=False), Path(file))


def told(
    file: Path,
    environment: Mapping[str, str] = os.environ,
    folder: Path = ROOT,
    prepare: Callable[[], None] = lambda: None,
    output: int | None = None,
    python: str = sys.executable,
    user: int | None = None,
) -> Memory:
    program = (
        f"import sys; sys.path.insert(0, {str(ROOT)!r}); from {__name__} import tell; tell({str(file)!r})"
    )
    subprocess.run(
        [python, "-c", program],
        env=environment,
        cwd=folder,
        preexec_fn=prepare,
        stdin=subprocess.DEVNULL,
        stdout=output,
        check=True,
        user=user,
        group=user,
        extra_groups=None if user is None else [],
    )
    return load(file)


def in_another_shell(folder: Path) -> dict[str, str]:
    """An environment of other size, language, home and search path."""
    return {
        **os.environ,
        **{f"MORE_{number}": "y" * number for number in range(60)},
        "PATH": f"{os.environ['PATH']}:/{'x' * 90}",
        "HOME": str(folder),
        "XDG_CACHE_HOME": str(folder / "cache"),
        "TMPDIR": str(folder),
        "LANG": "de_DE.UTF-8",
        "TZ": "Pacific/Auckland",
        "COLUMNS": "37",
    }


def be_another_process() -> None:
    """Be nice, on one processor, with limits, open files and signals as few have them."""
    os.nice(5)
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    resource.setrlimit(resource.RLIMIT_STACK, (64 << 20, resource.getrlimit(resource.RLIMIT_STACK)[1]))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGUSR1):
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR2})
    for _ in range(20):
        os.set_inheritable(os.open(os.devnull, os.O_RDONLY), True)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> tuple[Memory, set[int]]:
    """What a server begins with, and where any two differ: pids and times."""
    folder = tmp_path_factory.mktemp("memory")
    told(folder / "first")  # compiles, if need be
    one, other = (told(folder / name) for name in ("one", "other"))
    usual = different(one, other, numbers=False)
    assert len(usual) < 200
    return one, usual


def test_in_another_shell(plain: tuple[Memory, set[int]], tmp_path: Path) -> None:
    one, usual = plain
    (tmp_path / "home").mkdir()
    other = told(tmp_path / "memory", in_another_shell(tmp_path / "home"), folder=tmp_path)
    assert len(different(one, other, numbers=False) - usual) <= FEW


@pytest.mark.soak
def test_in_another_kind_of_process(plain: tuple[Memory, set[int]], tmp_path: Path) -> None:
    one, usual = plain
    other = told(tmp_path / "memory", prepare=be_another_process, output=subprocess.PIPE)
    assert len(different(one, other, numbers=False) - usual) <= FEW


@pytest.mark.soak
def test_from_python_by_another_of_its_names(plain: tuple[Memory, set[int]], tmp_path: Path) -> None:
    """A script that pip installs names ``python3``, a shell perhaps ``python``."""
    one, usual = plain
    own = Path(sys.executable)
    names = {own.with_name(name) for name in ("python", "python3")} - {own}
    other = told(tmp_path / "memory", python=str(names.pop()))
    assert len(different(one, other, numbers=False) - usual) <= FEW


@pytest.mark.soak
def test_where_other_packages_are_installed_too(tmp_path: Path) -> None:
    """Extras, tools of one's own: numba and pydantic look for extensions, and some for what is optional."""
    venv.create(tmp_path / "venv")
    python = str(tmp_path / "venv" / "bin" / "python")
    packages = next((tmp_path / "venv" / "lib").iterdir()) / "site-packages"
    (packages / "ours.pth").write_text(sysconfig.get_path("purelib"))
    told(tmp_path / "first", python=python)  # compiles
    one, again = (told(tmp_path / name, python=python) for name in ("one", "again"))
    (packages / "more.pth").write_text("import zipfile, decimal\n")
    for folder in (packages / name for name in (*OPTIONAL, *MORE)):
        folder.mkdir()
        (folder / "__init__.py").write_text("import fractions\n")
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {folder.name}\nVersion: 1.0\n")
        (folder / "entry_points.txt").write_text(f"[console_scripts]\n{folder.name} = nothing:main\n")
    other = told(tmp_path / "other", python=python)
    usual = different(one, again, numbers=False)
    assert len(usual) < 200
    assert len(different(one, other, numbers=False) - usual) <= FEW


@pytest.mark.soak
@pytest.mark.skipif(os.getuid() != 0, reason="only root can be another user")
def test_of_another_account(plain: tuple[Memory, set[int]]) -> None:
    """Root makes namespaces as it likes, others need one for users first; each has its own compiled code."""
    one, usual = plain
    same = "import os, sys; sys.exit([sys.version, os.__file__] != sys.argv[1:])"
    asked = subprocess.run(
        [sys.executable, "-c", same, sys.version, os.__file__],
        cwd="/",
        user=NOBODY,
        capture_output=True,
        check=False,
    )
    if asked.returncode:
        pytest.skip("another user may not run this Python: its folder is closed")
    with TemporaryDirectory() as folder:
        Path(folder).chmod(0o777)
        other = told(Path(folder) / "memory", in_another_shell(Path(folder)), Path("/"), user=NOBODY)
    assert len(different(one, other, numbers=False) - usual) <= FEW + OF_A_USER


@pytest.mark.soak
def test_on_a_terminal(plain: tuple[Memory, set[int]], tmp_path: Path) -> None:
    one, usual = plain
    terminal, ours = os.openpty()
    try:
        other = told(tmp_path / "memory", output=ours)
    finally:
        os.close(terminal)
        os.close(ours)
    assert len(different(one, other, numbers=False) - usual) <= FEW
