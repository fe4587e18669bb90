"""Code that is narrowed to a source line or a function of Rust: each struck instruction is of it."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from injector.program.profile import ScopeError
from injector.program.spec import ProgramSpec
from services.models.faults.specification import FaultSpec
from services.models.outcome import InjectionRecord
from tests.injector.program.launched import compiled, injector_of, spec_of

FAULT = FaultSpec(target="program", scope="thread")

LINES = """#include <stdio.h>
#include "product.h"
unsigned long table[64];
int main(void) {
    volatile unsigned long sum = 0;
    for (unsigned long at = 0; at < 64; at++)
        table[at] = at;
    for (unsigned long at = 0; at < 500; at++)
        sum = product(sum, table[at % 64]);
    if (sum == 1)
        puts("one");
    printf("%lu\\n", sum);
}
"""
PRODUCT = """static inline unsigned long product(unsigned long a, unsigned long b) {
    return a * 3 + (b ^ a >> 7);
}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "product.h").write_text(PRODUCT)
    return tmp_path


def struck(spec: ProgramSpec, runs: int) -> list[InjectionRecord]:
    with injector_of(spec) as injector:
        _, points = injector.draw(FAULT, 1, range(runs))
        return [run.injection for _, run in injector.run(points, FAULT, 1)]


def as_addr2line_tells(program: Path, records: list[InjectionRecord]) -> list[str]:
    tool = shutil.which("addr2line")
    if tool is None:
        pytest.skip("no addr2line (binutils) on this machine")
    command: list[str | Path] = [tool, "-e", program, *(hex(one.offset) for one in records)]
    told = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return re.sub(r" \(discriminator \d+\)", "", told).splitlines()


@pytest.mark.parametrize("options", [("-gdwarf-4",), ("-gdwarf-4", "-no-pie", "-O2")])
@pytest.mark.parametrize("asked", ["lines.c:9", "product.h:2"])
def test_only_code_of_the_line_is_struck(folder: Path, options: tuple[str, ...], asked: str) -> None:
    program = compiled(folder, LINES, "lines", *options)
    records = struck(spec_of([program], line=asked), 6)
    assert {one.status for one in records} == {"injected"}
    assert {one.line for one in records} == {f"{folder}/{asked}"}
    assert as_addr2line_tells(program, records) == [f"{folder}/{asked}"] * 6
    assert len({one.offset for one in records}) > 1


def test_a_line_of_a_library_is_struck(folder: Path) -> None:
    library = folder / "libproduct.so"
    text = """#include "product.h"
unsigned long given(unsigned long a, unsigned long b) { return product(a, b); }
"""
    compiled(folder, text, library.name, "-g", "-shared", "-fPIC")
    caller = """unsigned long given(unsigned long, unsigned long);
int main(void) { unsigned long a = 1; for (int at = 0; at < 99; at++) a = given(a, at); return a == 7; }
"""
    program = compiled(folder, caller, "caller", str(library), f"-Wl,-rpath,{folder}")
    records = struck(spec_of([program], line="product.h:2"), 3)
    assert {(one.module, one.line) for one in records} == {(library.name, f"{folder}/product.h:2")}


def test_records_tell_the_line_whatever_is_struck(folder: Path) -> None:
    program = compiled(folder, LINES, "lines", "-gdwarf-4")
    records = struck(spec_of([program], module="lines"), 15)
    lines = [one.line or "??:0" for one in records]
    assert [re.sub(":[?]$", ":0", one) for one in as_addr2line_tells(program, records)] == lines
    assert {f"{folder}/lines.c:{number}" for number in (8, 9)} <= set(lines)
    stripped = compiled(folder, LINES, "stripped", "-g0")
    assert {one.line for one in struck(spec_of([stripped], module="stripped"), 3)} == {""}


def test_a_line_is_narrowed_further(folder: Path) -> None:
    program = compiled(folder, LINES, "lines", "-g")
    addresses = {one.offset for one in struck(spec_of([program], line="lines.c:7"), 6)}
    one = min(addresses)
    narrowed = spec_of([program], line="lines.c:7", module="lines", address=one)
    assert {record.offset for record in struck(narrowed, 2)} == {one}
    with (
        injector_of(spec_of([program], line="lines.c:7", symbol="_start")) as injector,
        pytest.raises(ScopeError, match="executes no instruction of the code that was asked for"),
    ):
        injector.draw(FAULT, 1, range(1))


@pytest.mark.parametrize(
    ("asked", "problem"),
    [
        (
            {"line": "lines.c:5000"},
            "'lines.c:5000' has no code; the nearest lines .*/lines.c that have: 12, 13",
        ),
        ({"line": "lines.c:11"}, "executes no instruction of the code that was asked for"),
        ({"line": "nothing.c:7"}, "'nothing.c:7': no code of such a file"),
        ({"line": "lines.c:7", "module": "libnothing"}, "module 'libnothing' is not loaded"),
    ],
)
def test_a_line_that_cannot_be_struck_is_told(folder: Path, asked: dict[str, str], problem: str) -> None:
    with (
        injector_of(spec_of([compiled(folder, LINES, "lines", "-g")], **asked)) as injector,
        pytest.raises(ScopeError, match=problem),
    ):
        injector.draw(FAULT, 1, range(1))


RUST = """mod work {
    pub fn total<T: Copy + Into<u64>>(values: &[T]) -> u64 {
        values.iter().fold(0, |sum, one| sum * 3 % 1009 + (*one).into())
    }
}
fn main() {
    println!("{}", work::total(&(0..100u32).collect::<Vec<_>>()));
}
"""


def test_functions_and_lines_of_rust_are_struck(folder: Path) -> None:
    compiler = shutil.which("rustc")
    if compiler is None:
        pytest.skip("no rustc on this machine")
    (folder / "sums.rs").write_text(RUST)
    command = [compiler, "-g", "-C", "symbol-mangling-version=v0", "sums.rs"]
    subprocess.run(command, cwd=folder, check=True)
    for asked in ({"symbol": "sums::work::total::<u32>"}, {"line": "sums.rs:3"}):
        records = struck(spec_of([folder / "sums"], **asked), 4)
        assert {one.line for one in records} <= {f"{folder}/sums.rs:{number}" for number in (2, 3, 4)}
        assert all("4work5total" in one.symbol for one in records)
