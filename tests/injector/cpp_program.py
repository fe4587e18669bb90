"""A C++ program that knows nothing of us: three threads map, the main one waits for them."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

_LIBRARY = """
#include <cmath>
namespace grid {
double insert(double x, int cells) {
    double sum = 0;
    for (int i = 1; i <= cells; i++) sum += std::sqrt(x) / i;
    return sum;
}
double insert(float x) { return x * 2.0; }
}
"""

_MAIN = """
#include <chrono>
#include <cstdio>
#include <thread>
#include <vector>
#include <sys/prctl.h>
namespace grid {
double insert(double, int);
double insert(float);
volatile double total;
volatile long rounds;
}
__attribute__((noinline)) long lengthy(long passes) {
    volatile long sum = 0;
    for (long i = 0; i < passes; i++) sum += i;
    return sum;
}
int main() {
    prctl(PR_SET_PTRACER, -1L, 0, 0, 0);
    prctl(PR_SET_PDEATHSIG, 9);
    std::vector<std::thread> several;
    for (int t = 0; t < 3; t++) several.emplace_back([t] {
        for (int round = 0;; round++) {
            grid::total = grid::insert(t + 1.0, 20);
            grid::total = grid::insert(1.0f * round);
            if (t == 0) { lengthy(30000000 + (round & 1)); grid::rounds = round; }
            else std::this_thread::sleep_for(std::chrono::microseconds(200));
        }
    });
    std::puts("ready"); std::fflush(stdout);
    for (auto &one : several) one.join();
}
"""


def compiled_cpp(made: Path, source: str, *options: str) -> Path:
    """The program or library that a text in C++ makes; the test is skipped where there is no compiler."""
    compiler = shutil.which("c++")
    if compiler is None:
        pytest.skip("no C++ compiler (c++) on this machine")
    text = made.with_suffix(".cpp")
    text.write_text(source)
    subprocess.run([compiler, "-O1", "-o", made, text, *options], check=True)
    return made


@pytest.fixture(scope="session")
def mapper(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The program; ``grid::insert`` lies in its library ``libgrid.so``, which has debug information."""
    folder = tmp_path_factory.mktemp("mapper")
    library = compiled_cpp(folder / "libgrid.so", _LIBRARY, "-g", "-shared", "-fPIC")
    return compiled_cpp(folder / "mapper", _MAIN, str(library), f"-Wl,-rpath,{folder}", "-pthread")


@contextmanager
def running_program(program: Path, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """The program while it runs."""
    process = subprocess.Popen([program, *arguments], stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        yield process
    finally:
        process.kill()
        process.communicate()
