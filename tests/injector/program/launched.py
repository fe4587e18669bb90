"""Programs in C that tests launch, and what they need to strike runs of them."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

from injector.program.program_injector import ProgramInjector
from injector.program.runs import ProgramRuns
from injector.program.spec import ProgramSpec

LIMIT_S = 60.0

COUNTS = """
#include <stdio.h>
#include <stdlib.h>
int main(int count, char **given) {
    unsigned long n = strtoul(given[1], 0, 10), sum = 0, left = n;
    for (unsigned long i = 1; i <= n; i++)
        __asm__ volatile(".globl probe\\nprobe: mov %1, %%rax\\nadd %%rax, %0"
                         : "+r"(sum) : "r"(i) : "rax", "cc");
    __asm__ volatile(".globl tight\\ntight: loop tight" : "+c"(left));
    left = n + 1;
    __asm__ volatile("push %0\\njmp 1f\\n.globl narrow\\nnarrow: push %0\\n"
                     "1: pop %%rax\\ndec %0\\njnz narrow" : "+c"(left) :: "rax", "cc");
    printf("%lu %lu\\n", sum, left);
}
"""
"""At ``probe`` a register that is read holds the number of the pass; at ``tight`` and ``narrow`` rcx counts
down. Only a short jump fits in at ``tight``, none at ``narrow``."""


def compiled(folder: Path, source: str, name: str, *options: str) -> Path:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler (cc) on this machine")
    text = folder / f"{name}.c"
    text.write_text(source)
    command = [compiler, "-O1", "-fcf-protection=none", str(text), *options, "-o", str(folder / name)]
    subprocess.run(command, check=True)
    return folder / name


def offset_of(program: Path, symbol: str) -> int:
    listed = subprocess.run(
        [shutil.which("nm") or "nm", program], check=True, capture_output=True, text=True
    ).stdout
    (line,) = [one for one in listed.splitlines() if one.endswith(f" {symbol}")]
    return int(line.split()[0], 16)


def spec_of(command: Sequence[str | Path], **more: object) -> ProgramSpec:
    found = shutil.which(command[0])
    assert found is not None
    whole = {
        "command": tuple(map(str, command)),
        "executable": str(found),
        "folder": "/",
        "environment": {"PATH": "/usr/bin:/bin"},
    }
    return ProgramSpec.model_validate(whole | more)


@contextmanager
def runs_of(spec: ProgramSpec) -> Iterator[ProgramRuns]:
    with (
        tempfile.TemporaryDirectory() as folder,
        ProgramRuns(spec, min(os.sched_getaffinity(0)), Path(folder)) as runs,
    ):
        yield runs


@contextmanager
def injector_of(spec: ProgramSpec) -> Iterator[ProgramInjector]:
    with runs_of(spec) as runs:
        yield ProgramInjector(runs, LIMIT_S)
