"""Launched programs: the same memory, pid and random bytes in each run, and nothing is left of one."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import asdict
from pathlib import Path

import pytest

from injector.program.launched_program import Launcher, LaunchError, Order, padded
from tests.conftest import descendants, wait_until
from tests.injector.program.launched import LIMIT_S, compiled

PROCESSOR = min(os.sched_getaffinity(0))
LOOK = """
#include <stdio.h>
#include <stdlib.h>
#include <sys/auxv.h>
#include <sys/random.h>
#include <unistd.h>
int main(void) {
    unsigned long drawn[2] = {0, 0}, *key = (unsigned long *)getauxval(AT_RANDOM);
    getrandom(drawn, 16, 0);
    printf("%d %p %p %p %lx %lx %lx\\n", getpid(), (void *)&drawn, (void *)main, malloc(10),
           drawn[0], drawn[1], *key);
}
"""


def order(folder: Path, program: Path | str, environment: dict[str, str], *arguments: str) -> Order:
    command = [str(program), *arguments]
    written = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
    streams = [("/dev/null", os.O_RDONLY), (str(folder / "out"), written), (str(folder / "err"), written)]
    whole = padded(command[0], command, environment)
    return Order(command[0], command, whole, str(folder), streams)


def told(launcher: Launcher, asked: Order) -> str:
    with launcher.launch(asked) as program:
        assert program.run_to_end(LIMIT_S)
        assert program.await_end().status == 0
    return Path(asked.streams[1][0]).read_text()


def test_a_program_finds_the_same_in_each_run_whatever_its_environment(tmp_path: Path) -> None:
    program = compiled(tmp_path, LOOK, "look")
    with Launcher(PROCESSOR, tmp_path) as one, Launcher(PROCESSOR, tmp_path) as other:
        runs = {
            told(one, order(tmp_path, program, {"NAME": "short"})),
            told(one, order(tmp_path, program, {"NAME": "of another length" * 50})),
            told(other, order(tmp_path, program, {"NAME": ""})),
        }
    assert len(runs) == 1
    assert len(set(runs.pop().split())) == 7


def test_a_program_can_change_files_in_its_own_folder_only(tmp_path: Path) -> None:
    own, kept = tmp_path / "own", tmp_path / "kept"
    own.mkdir()
    kept.write_text("of the user")
    tries = f"rm -f {kept}; echo x >> {kept}; echo y > {tmp_path}/new; mv {kept} {own}; echo z > {own}/new"
    devices = "echo on > /dev/null; echo on > /dev/shm/$$; rm /dev/shm/$$"
    asked = order(own, "/bin/sh", {}, "-c", f"{tries}; {devices}")
    with Launcher(PROCESSOR, own) as launcher:
        told(launcher, asked)
        assert launcher.protects
    assert kept.read_text() == "of the user"
    assert sorted(one.name for one in tmp_path.iterdir()) == ["kept", "own"]
    assert (own / "new").read_text() == "z\n"
    assert (own / "err").read_text().count("Read-only file system") == 4


def test_a_launcher_that_nobody_listens_to_ends_in_silence(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    command = [sys.executable, "-P", "-m", "injector.program.launcher", str(PROCESSOR), str(tmp_path)]
    reads, writes = os.pipe()
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=writes) as process:
        os.close(writes)
        os.close(reads)
        process.communicate(json.dumps(asdict(order(tmp_path, "/bin/true", {}))).encode() + b"\n")
    assert process.returncode == 0
    assert capfd.readouterr() == ("", "")


def test_what_cannot_be_executed_is_said(tmp_path: Path) -> None:
    text = tmp_path / "text"
    text.write_text("no program")
    text.chmod(0o755)
    with (
        Launcher(PROCESSOR, tmp_path) as launcher,
        pytest.raises(LaunchError, match="Exec format error"),
        launcher.launch(order(tmp_path, text, {})),
    ):
        pass
    with Launcher(PROCESSOR, tmp_path) as launcher:
        assert told(launcher, order(tmp_path, "/bin/echo", {}, "hello")) == "hello\n"


def test_nothing_of_a_run_is_left(tmp_path: Path) -> None:
    asked = order(
        tmp_path, "/bin/sh", {"PATH": "/usr/bin:/bin"}, "-c", "sleep 1000 & setsid sleep 1000 & wait"
    )
    with Launcher(PROCESSOR, tmp_path) as launcher:
        with launcher.launch(asked) as program:
            assert not program.run_to_end(0.5)
            started = {thread.pid for thread in program.threads.values()}
        assert len(started) == 3
        wait_until(lambda: not [one for one in started if Path(f"/proc/{one}/exe").exists()], LIMIT_S)
        assert told(launcher, order(tmp_path, "/bin/echo", {}, "on")) == "on\n"


def test_all_die_with_who_traces_them(tmp_path: Path) -> None:
    asked = order(tmp_path, "/bin/sh", {"PATH": "/usr/bin:/bin"}, "-c", "setsid sleep 1000 & sleep 1000")
    pid = os.fork()
    if not pid:
        try:
            with Launcher(PROCESSOR, tmp_path) as launcher, launcher.launch(asked) as program:
                program.run_to_end(LIMIT_S)
        finally:
            os._exit(1)
    wait_until(lambda: len(descendants(pid)) >= 4, LIMIT_S)
    started = descendants(pid)
    time.sleep(0.2)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    wait_until(lambda: not [one for one in started if Path(f"/proc/{one}/exe").exists()], LIMIT_S)
