"""The folder of compiled code: one for an installation, filled by one process, found by all others."""

import hashlib
import os
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from deploy.mission.fork_server import ForkServer
from injector.reproducible.compiled_code import parent_folder

ROOT = Path(__file__).parents[3]
NOBODY = 65534

FILLING = """
import os, sys
from pathlib import Path
from injector.reproducible import compiled_code
if len(sys.argv) > 2:
    compiled_code.ROOT = Path(sys.argv[2])
compiled_code.open_folder(Path(sys.argv[1]), {})
print(compiled_code.is_unfinished(), flush=True)
sys.stdin.readline()
(compiled_code.folder() / "code").touch()
if compiled_code.is_unfinished():
    compiled_code.finish()
print(compiled_code.folder().name, flush=True)
"""


def filling(parent: Path, *sources: Path) -> "subprocess.Popen[str]":
    command = [sys.executable, "-c", FILLING, str(parent), *map(str, sources)]
    return subprocess.Popen(command, cwd=ROOT, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE)


def line(process: "subprocess.Popen[str]") -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def test_one_fills_it_and_the_next_finds_it_whole(tmp_path: Path) -> None:
    with filling(tmp_path) as one:
        assert line(one) == "True"
        other = filling(tmp_path)  # waits
        assert not any((folder / "code").exists() for folder in tmp_path.iterdir())
        name = one.communicate("go\n")[0].strip()
    with other:
        assert line(other) == "False"
        assert (tmp_path / name / "code").exists()
        assert other.communicate("go\n")[0].strip() == name
    assert sorted(one.name for one in tmp_path.iterdir()) == [name, "lock"]


def test_what_one_left_half_filled_is_begun_anew(tmp_path: Path) -> None:
    with filling(tmp_path) as process:
        assert line(process) == "True"
        (half,) = tmp_path.glob("*.new")
        (half / "half").touch()
        process.kill()
    with filling(tmp_path) as process:
        assert line(process) == "True"
        name = process.communicate("go\n")[0].strip()
    assert [one.name for one in (tmp_path / name).iterdir()] == ["code"]


def test_a_change_of_any_source_begins_another(tmp_path: Path) -> None:
    """What is kept of a function depends on what else was in memory when it was compiled."""
    (tmp_path / "services").mkdir()
    (tmp_path / "services" / "wiring.py").write_text("")
    begun = []
    for content in ("", "", "more = 1"):
        if content:
            (tmp_path / "services" / "wiring.py").write_text(content)
        with filling(tmp_path / "folders", tmp_path) as process:
            begun.append(line(process))
            process.communicate("go\n")
    assert begun == ["True", "False", "True"]


def test_it_lies_beside_our_byte_code_or_where_the_user_says(tmp_path: Path) -> None:
    beside = parent_folder({"HOME": str(tmp_path)})
    assert beside.parent.parent == ROOT / "injector" / "reproducible"
    assert parent_folder({"NUMBA_CACHE_DIR": str(tmp_path)}).is_relative_to(tmp_path)


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a folder to another user")
def test_what_another_user_has_filled_is_left_alone(tmp_path: Path) -> None:
    beside, cache = tmp_path / "__pycache__", {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    assert parent_folder(cache, beside) == beside / "compiled"
    (beside / "compiled").mkdir(parents=True, mode=0o777)
    assert parent_folder(cache, beside) == beside / "compiled"
    os.chown(beside / "compiled", NOBODY, -1)
    assert parent_folder(cache, beside) == tmp_path / "cache" / "zenfi" / "compiled"


@pytest.mark.soak
def test_where_and_with_what_cold_it_is_compiled_makes_no_difference(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []
    for name in ("one", "other"):
        folder = tmp_path / name
        folder.mkdir()
        monkeypatch.chdir(folder)
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder))
        if name == "one":
            for file in (ROOT / "services").rglob("*.pyc"):
                file.unlink()
        with closing(ForkServer()):
            pass
        files = sorted(folder.rglob("*.nb?"))
        # Those of the detector are compiled by the process that forks sidecars, which are not struck.
        nodes = [file for file in files if "schemes_" not in file.parent.name]
        assert len(nodes) > 50
        seen.append({file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in nodes})
    assert seen[0] == seen[1]


def test_a_fork_server_has_its_code_from_there() -> None:
    with closing(ForkServer()) as server:
        given = Path(f"/proc/{server.pid}/environ").read_bytes().split(b"\0")
    assert b"NUMBA_CACHE_DIR=/proc/self/fd/111" in given
    assert b"HOME=/nonexistent" in given
    assert not any(one.startswith(b"XDG_") for one in given)
    assert f"PATH={os.environ['PATH']}".encode() not in given
