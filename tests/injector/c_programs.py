"""Small C programs to be injected into: ``kernel`` runs once a round and its result is printed.

Before every call the program sends itself a signal, by which the test gets hold of it.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

from injector.faults.stopped_thread import registers_of
from injector.tracing.process import Process, ProcessIdentity
from injector.tracing.tracee import Tracee
from injector.tracing.tracees import TraceeGroup
from injector.tracing.waiting import wait_until

MARK = signal.SIGUSR1
PATIENCE_S = 30.0

_MAIN = """
#include <signal.h>
#include <stdio.h>
#include <sys/prctl.h>
#include <unistd.h>
double kernel(void);
int main(void) {
    prctl(PR_SET_PTRACER, -1L, 0, 0, 0);
    prctl(PR_SET_PDEATHSIG, SIGKILL);
    signal(SIGUSR1, SIG_IGN);
    signal(SIGUSR2, SIG_IGN);
    printf("%lu\\n", (unsigned long)kernel);
    fflush(stdout);
    while (getchar() != EOF) {
        kill(getpid(), SIGUSR1);
        printf("%.17g\\n", kernel());
        fflush(stdout);
    }
}
"""


def compiled(folder: Path, kernel: str, library: str = "") -> Path:
    """The program with this kernel, which with a ``library`` lies in a shared library of that name."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler (cc) on this machine")
    (folder / "main.c").write_text(_MAIN)
    (folder / "kernel.c").write_text(kernel)
    command = [compiler, "-O1", "-fno-stack-protector", "-fcf-protection=none", "-o"]
    program = folder / "program"
    sources = [folder / "main.c", folder / "kernel.c"]
    if library:
        subprocess.run([*command, folder / library, "-shared", "-fPIC", sources.pop()], check=True)
        sources.append(folder / library)
    subprocess.run([*command, program, *sources, f"-Wl,-rpath,{folder}"], check=True)
    return program


class Program:
    """A running program."""

    def __init__(self, path: Path) -> None:
        self.process = subprocess.Popen([path], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.pid = self.process.pid
        self.kernel = int(self._line())

    def _line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().decode().strip()

    def begin(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(b"\n")
        self.process.stdin.flush()

    def result(self) -> str:
        """What the round's kernel returned; empty if the program died of it."""
        return self._line()

    def round(self) -> str:
        """A round without us."""
        self.begin()
        return self.result()

    @contextmanager
    def at_kernel(self, entered: bool = True) -> Iterator[tuple[TraceeGroup, Tracee, Process]]:
        """Begin a round and stand at the first instruction of its kernel, or at the mark before it."""
        with Process(ProcessIdentity.of(self.pid)) as process, TraceeGroup(MARK) as tracees:
            tracees.seize([self.pid])
            thread = tracees.threads[self.pid]
            self.begin()

            def at_the_mark() -> bool | None:
                tracees.service()
                return True if thread.report is not None and thread.report.kind == "gate" else None

            assert wait_until(at_the_mark, PATIENCE_S)
            tracees.stop_all()
            while entered and registers_of(thread).program_counter != self.kernel:
                assert tracees.step(thread) == "stepped"
            yield tracees, thread, process

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()


@contextmanager
def running_program(path: Path) -> Iterator[Program]:
    program = Program(path)
    try:
        yield program
    finally:
        program.close()


def assembly(lines: Sequence[str], declarations: str = "") -> str:
    """A kernel of these instructions, which leave their result in rax."""
    text = "".join(f'"{line}\\n"' for line in lines)
    return f"""{declarations}
double kernel(void) {{
    long result;
    __asm__ volatile({text} : "=a"(result) : : "rbx", "rcx", "rdx", "xmm0", "xmm1", "memory", "cc");
    return result;
}}
"""


def kill(program: Program, number: signal.Signals) -> None:
    os.kill(program.pid, number)
