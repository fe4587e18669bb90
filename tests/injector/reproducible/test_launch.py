"""Processes that begin with the same memory, whoever starts them and whatever lies about."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

from injector.reproducible import launch

ROOT = Path(__file__).parents[3]
GIVES_BACK = """
from injector.reproducible.bootstrap import give_back_standard_streams
give_back_standard_streams()
"""
TELLING = """
import ctypes, os
libc = ctypes.CDLL(None)
libc.getauxval.restype = libc.malloc.restype = ctypes.c_void_p
random = ctypes.string_at(libc.getauxval(25), 16).hex()
block = libc.malloc(24)
libc.free(ctypes.c_void_p(block))
print(os.urandom(8).hex())
print(random, ctypes.string_at(block + 8, 8).hex(), hex(block), hex(id(object())))
"""


def told(folder: Path, module: str = "telling.told", of: Mapping[str, str] = os.environ) -> str:
    given = {**of, "PYTHONPATH": str(folder), "NUMBA_CACHE_DIR": str(folder)}
    surroundings = launch.environment(given, "test") | {"PYTHONPATH": str(folder)}
    command = launch.command(module, "argument")
    return subprocess.run(
        command, env=surroundings, cwd=folder, capture_output=True, text=True, check=True
    ).stdout


def package(folder: Path) -> Path:
    """A folder with our packages and one more."""
    for ours in ("injector", "services"):
        (folder / ours).symlink_to(ROOT / ours)
    (folder / "telling").mkdir()
    (folder / "telling" / "__init__.py").touch()
    (folder / "telling" / "told.py").write_text(GIVES_BACK + TELLING)
    told(folder)  # compiles
    return folder


def test_the_keys_and_the_addresses_are_those_of_every_other(tmp_path: Path) -> None:
    folder = package(tmp_path)
    keys = told(folder).split()
    assert told(folder).split() == keys
    # Here they are others each time, but for where things lie.
    drawn = [subprocess.check_output([sys.executable, "-c", TELLING], text=True).split() for _ in range(2)]
    assert all(one != other for one, other, key in zip(*drawn, keys, strict=True) if not key.startswith("0x"))


COMPILING = """
import os, sys
from pathlib import Path
from injector.reproducible import compiled_code, launch
starts = Path(sys.argv[1])
with starts.open("a") as file:
    file.write("x")
if starts.stat().st_size < 3:
    os.utime(Path(sys.argv[2]))
launch.begin_again_to_compile()
launch.begin_again_if(False)
print(compiled_code.is_unfinished(), starts.stat().st_size)
"""


def test_who_compiles_lets_others_go_on_though_sources_are_changed_meanwhile(tmp_path: Path) -> None:
    """It held the lock as long as it lived, and every other process waited."""
    for ours in ("injector", "services"):
        shutil.copytree(ROOT / ours, tmp_path / ours, ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "compiling.py").write_text(COMPILING)
    given = {**os.environ, "PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    surroundings = launch.environment(given, "test") | {"PYTHONPATH": str(tmp_path)}
    command = launch.command("compiling", str(tmp_path / "starts"), str(tmp_path / "services" / "kernels.py"))
    ended = subprocess.check_output(command, env=surroundings, cwd=tmp_path, text=True)
    assert ended == "False 4\n"


def test_a_file_beside_our_packages_changes_nothing(tmp_path: Path) -> None:
    folder = package(tmp_path)
    before = told(folder)
    for number in range(500):
        (folder / f"a_recording_{number}").touch()
    assert told(folder) == before


def test_all_that_python_would_find_beside_our_packages_is_found(tmp_path: Path) -> None:
    """In an installation that is all that they need."""
    folder = package(tmp_path)
    (folder / "single.py").touch()
    (folder / "namespace").mkdir()
    (folder / "namespace" / "part.py").touch()
    (folder / f"extension{EXTENSION_SUFFIXES[0]}").touch()
    (folder / "another-1.dist-info").mkdir()
    (folder / "another-1.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: another\nVersion: 1\n"
    )
    imports = (
        "from importlib.metadata import version\n"
        "from importlib.util import find_spec\n"
        "import namespace.part, single, telling\n"
        "print(*(one.__file__ for one in (namespace.part, single, telling)))\n"
        "print(find_spec('extension').origin, version('another'), find_spec('nowhere'))\n"
    )
    (folder / "telling" / "imports.py").write_text(GIVES_BACK + imports)
    found = [folder / "namespace" / "part.py", folder / "single.py", folder / "telling" / "__init__.py"]
    assert told(folder, "telling.imports").splitlines() == [
        " ".join(map(str, found)),
        f"{folder / 'extension'}{EXTENSION_SUFFIXES[0]} 1 None",
    ]


def test_a_file_beside_our_packages_takes_no_place_in_the_standard_library(tmp_path: Path) -> None:
    folder = package(tmp_path)
    (folder / "statistics.py").write_text("raise RuntimeError('not the standard library')\n")
    (folder / "telling" / "counts.py").write_text(
        GIVES_BACK + "import statistics\nprint(statistics.mean([1, 3]))\n"
    )
    assert told(folder, "telling.counts") == "2\n"


def test_one_that_had_to_compile_begins_again_with_the_same_memory(tmp_path: Path) -> None:
    folder = package(tmp_path)
    program = (
        "import os, sys\n"
        "from telling import other\n"
        "from injector.reproducible.launch import begin_again_if\n"
        "os.write(114, b'%s %d\\n' % (other.NAME.encode(), os.getpid()))\n"
        "begin_again_if(False)\n"
        "print([hex(id(one)) for one in (other, *os.environ.items(), *sys.argv)], os.environ, sys.argv)\n"
    )
    (folder / "telling" / "twice.py").write_text(program)
    other = folder / "telling" / "other.py"
    other.write_text("NAME = 'one'\n")
    *compiled, memory = told(folder, "telling.twice").splitlines()
    assert len(compiled) == 2  # the same process, again
    assert len(set(compiled)) == 1
    time.sleep(1.5)  # what was written just before a start might have been written since
    once = told(folder, "telling.twice").splitlines()
    assert len(once) == 2
    assert once[1] == memory
