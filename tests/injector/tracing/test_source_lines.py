"""Source lines of code, by all debug information that compilers write, in the file and beside it."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from injector.tracing import source_lines
from injector.tracing.process import MemoryMap
from injector.tracing.source_lines import SourceLineError, SourceLines, code_of_line, parsed_line

MAIN = """#include "more.h"
static int unused(int x) { return x * 3; }
int twice(int x) {
    return x + x;
}
__attribute__((section(".text.far"))) int far(int x) {
    return inlined(x);
}
int main(int count, char **given) {
    return twice(count) - far(count);
}
"""
HEADER = """static inline __attribute__((always_inline)) int inlined(int x) {
    return x ^ 5;
}
"""


@pytest.fixture
def source(tmp_path: Path) -> Path:
    for name, text in (("src/main.c", MAIN), ("src/more.h", HEADER), ("other/src/more.h", HEADER)):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def built(folder: Path, compiler: str, *options: str, what: str = "src/main.c") -> Path:
    found = shutil.which(compiler)
    if found is None:
        pytest.skip(f"no {compiler} on this machine")
    subprocess.run([found, *options, what, "-o", "made"], cwd=folder, check=True)
    return folder / "made"


def said(tool: str, *arguments: str | Path) -> str:
    found = shutil.which(tool)
    if found is None:
        pytest.skip(f"no {tool} on this machine")
    return subprocess.run([found, *arguments], check=True, capture_output=True, text=True).stdout


def instructions(program: Path) -> list[int]:
    listed = said("objdump", "-d", "--no-show-raw-insn", program)
    return [int(one, 16) for one in re.findall(r"^ +([0-9a-f]+):\t", listed, re.MULTILINE)]


def line_of(program: Path, address: int) -> str:
    return SourceLines().at(os.getpid(), str(program), address)


def lines_of(program: Path) -> set[str]:
    lines = SourceLines()
    return {lines.at(os.getpid(), str(program), one) for one in instructions(program)}


def as_if_loaded(*files: Path) -> MemoryMap:
    """The map of a process with the code of some files, each from a multiple of 0x1000000 on."""
    lines = []
    for number, file in enumerate(files, 1):
        segments = re.findall(r"LOAD +0x(\w+) 0x(\w+) 0x\w+ 0x(\w+) 0x\w+ R E", said("readelf", "-lW", file))
        for start, virtual, size in ([int(one, 16) for one in segment] for segment in segments):
            begin = number * 0x1000000 + virtual - start % 4096
            end = begin + -(-(size + start % 4096) // 4096) * 4096
            lines.append(f"{begin:x}-{end:x} r-xp {start - start % 4096:x} 0:0 1 {file}")
    return MemoryMap("\n".join(lines))


def code(asked: str, *files: Path) -> set[int]:
    """The addresses of instructions of a line, as in the file."""
    ranges = code_of_line(os.getpid(), as_if_loaded(*files), asked)
    every = {0x1000000 * number + one for number, file in enumerate(files, 1) for one in instructions(file)}
    return {one % 0x1000000 for one in every if any(begin <= one < end for begin, end in ranges)}


KINDS = (
    ("gcc", "-gdwarf-3", "-O2"),
    ("gcc", "-gdwarf-4", "-O0"),
    ("gcc", "-gdwarf-4", "-O2", "-no-pie"),
    ("gcc", "-gdwarf-5", "-O2"),
    ("gcc", "-g", "-gz"),
    ("gcc", "-g", "-shared", "-fPIC"),
    ("gcc", "-g", "-gsplit-dwarf"),
    ("gcc", "-g", "-O2", "-ffunction-sections", "-Wl,--gc-sections"),
    ("clang", "-gdwarf-4", "-O2"),
    ("clang", "-gdwarf-5", "-O0", "-no-pie"),
)


@pytest.mark.parametrize("kind", KINDS, ids=" ".join)
def test_each_instruction_is_of_the_line_that_addr2line_tells(source: Path, kind: tuple[str, ...]) -> None:
    program = built(source, *kind)
    if "-gsplit-dwarf" in kind:  # addr2line looks for the other half
        program = program.rename(source / "split")
    lines, addresses = SourceLines(), instructions(program)
    told = said("addr2line", "-e", program, *map(hex, addresses)).splitlines()
    for address, reference in zip(addresses, told, strict=True):
        file, line = re.fullmatch(r"(.*):(\d+|\?)(?: \(discriminator \d+\))?", reference).groups()  # type: ignore[union-attr]
        ours = lines.at(os.getpid(), str(program), address)
        if line in ("?", "0"):
            assert "-gsplit-dwarf" in kind or ours == ""
            continue
        assert ours.rpartition(":")[2] == line
        if "-gdwarf-5" not in kind and "-g" not in kind:  # binutils 2.40 takes wrong files of version 5
            assert ours == f"{os.path.normpath(file)}:{line}"
    known = {lines.at(os.getpid(), str(program), one) for one in addresses}
    assert {f"{source}/src/main.c:4", f"{source}/src/more.h:2"} <= known
    for line in known - {""}:
        expected = {one for one in addresses if lines.at(os.getpid(), str(program), one) == line}
        assert code(line, program) == expected


@pytest.mark.parametrize("version", ["-gdwarf-3", "-gdwarf-5"])
def test_a_unit_in_one_piece_is_found_without_a_table_of_units(source: Path, version: str) -> None:
    (source / "src/main.c").write_text("int main(int count, char **given) {\n    return count * 3;\n}\n")
    program = built(source, "clang", version)
    assert {f"{source}/src/main.c:{line}" for line in (1, 2)} | {""} == lines_of(program)
    assert code("main.c:2", program) != set()


def test_code_that_the_linker_has_left_out_is_none(source: Path) -> None:
    # Its rows stay, from address 0 on, and reach into what is linked.
    unused = 'void unused_and_long(void) {\n    __asm__ volatile(".fill 8192, 1, 0x90");\n}\n'
    (source / "src/main.c").write_text(f"{MAIN}{unused}")
    program = built(source, "gcc", "-g", "-ffunction-sections", "-Wl,--gc-sections")
    assert not {f"{source}/src/main.c:{line}" for line in (12, 13, 14)} & lines_of(program)
    with pytest.raises(SourceLineError, match=r"has no code; the nearest lines .* that have: 10, 11"):
        code("main.c:13", program)


def test_a_path_with_steps_back_is_the_one_without(source: Path) -> None:
    program = built(source, "gcc", "-g", what="other/../src/main.c")
    assert f"{source}/src/main.c:4" in lines_of(program)
    assert code(f"{source}/src/main.c:4", program) == code("other/../src/main.c:4", program) != set()


@pytest.mark.parametrize(
    "name", ["src/main.c", "main.c", "./src/main.c", "src/../src/main.c", "{}/src/main.c"]
)
def test_a_file_is_named_as_it_was_compiled_or_by_the_end_of_its_path(source: Path, name: str) -> None:
    program = built(source, "gcc", "-g")
    assert code(f"{name.format(source)}:4", program) == code(f"{source}/src/main.c:4", program) != set()


@pytest.mark.parametrize(
    ("asked", "problem"),
    [
        ("main.c:5000", r"has no code; the nearest lines of .*/src/main.c that have: 10, 11"),
        ("main.c:1", r"has no code; the nearest lines of .*/src/main.c that have: 2, 3"),
        ("ain.c:4", "no code of such a file"),
        ("more.h:2", r"2 files end so: give more of the path: .*/other/src/more.h; .*/src/more.h"),
    ],
)
def test_a_line_without_code_is_told_in_a_line(source: Path, asked: str, problem: str) -> None:
    first = built(source, "gcc", "-g").rename(source / "first")
    (source / "src/../other/src/main.c").write_text(MAIN)
    second = built(source, "gcc", "-g", what="other/src/main.c").rename(source / "second")
    with pytest.raises(SourceLineError, match=problem) as raised:
        code(asked, first, second) if "more" in asked else code(asked, first)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("asked", ["main.c", "main.c:", ":3", "main.c:0", "main.c:-1", "main.c:x", ""])
def test_what_is_no_line_is_refused(asked: str) -> None:
    with pytest.raises(SourceLineError, match="expected FILE:LINE"):
        parsed_line(asked)


def separated(source: Path, *options: str) -> tuple[Path, Path]:
    """A program without debug information, and a file with it."""
    program, debug = built(source, "gcc", "-g", *options), source / "made.debug"
    said("objcopy", "--only-keep-debug", program, debug)
    said("objcopy", "--strip-all", f"--add-gnu-debuglink={debug}", program)
    return program, debug


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(source_lines, "SEPARATE", str(tmp_path / "installed"))
    return tmp_path / "installed"


@pytest.mark.parametrize("where", ["beside", "folder", "installed", "build id"])
def test_debug_information_in_a_separate_file_is_found(source: Path, installed: Path, where: str) -> None:
    program, debug = separated(source, "-Wl,--build-id")
    address = instructions(program)[-1]
    build_id = re.search(r"Build ID: (\w+)", said("readelf", "-n", program))[1]  # type: ignore[index]
    place = {
        "beside": debug,
        "folder": source / ".debug/made.debug",
        "installed": Path(f"{installed}{source}/made.debug"),
        "build id": installed / f".build-id/{build_id[:2]}/{build_id[2:]}.debug",
    }[where]
    place.parent.mkdir(parents=True, exist_ok=True)
    debug.rename(place)
    found = lines_of(program)
    assert {f"{source}/src/main.c:{line}" for line in (4, 10)} <= found
    place.unlink()
    assert line_of(program, address) == ""
    with pytest.raises(
        SourceLineError, match="no debug information in made: compile with -g, or install the"
    ):
        code("main.c:4", program)


@pytest.mark.parametrize("where", ["beside", "build id"])
def test_debug_information_of_another_program_is_not_taken(source: Path, installed: Path, where: str) -> None:
    program, debug = separated(source, "-Wl,--build-id=0x1234567890abcdef")
    place = debug if where == "beside" else installed / ".build-id/12/34567890abcdef.debug"
    place.parent.mkdir(parents=True, exist_ok=True)
    (source / "src/main.c").write_text(f"\n\n\n{MAIN}")
    other = built(source, "gcc", "-g", "-Wl,--build-id=0xfedcba0987654321")
    wrong = other.rename(source / "other_program").read_bytes()
    program = separated(source, "-Wl,--build-id=0x1234567890abcdef")[0]
    debug.unlink()
    place.write_bytes(wrong)
    assert lines_of(program) == {""}


def test_damaged_debug_information_is_none_and_told_of(source: Path) -> None:
    program = built(source, "gcc", "-g")
    whole = program.read_bytes()
    address = instructions(program)[-1]
    offset, size = (
        int(one, 16)
        for one in re.search(
            r"\.debug_line +PROGBITS +\w+ (\w+) (\w+)", said("readelf", "-SW", program)
        ).groups()  # type: ignore[union-attr]
    )
    assert code("main.c:4", program)
    program.write_bytes(whole[:offset] + b"\xff" * size + whole[offset + size :])
    assert line_of(program, address) == ""
    name_is_mentioned = whole[:offset] + b"\xff" * (size - 7) + b"main.c\0" + whole[offset + size :]
    program.write_bytes(name_is_mentioned)
    with pytest.raises(SourceLineError, match=r"line 'main.c:4': made: debug information cannot be read"):
        code_of_line(os.getpid(), as_if_loaded(program), "main.c:4")


@pytest.mark.soak
def test_whatever_is_damaged_ends_with_one_line_or_none(source: Path) -> None:
    program = built(source, "gcc", "-gdwarf-4")
    whole, address, maps = program.read_bytes(), instructions(program)[-1], as_if_loaded(program)
    sections = re.findall(r"\.debug_\w+ +PROGBITS +\w+ (\w+) (\w+)", said("readelf", "-SW", program))
    assert len(sections) >= 5
    told = set()
    for start, size in ((int(start, 16), int(size, 16)) for start, size in sections):
        for place in range(start, start + size, max(1, size // 20)):
            for value in (0x00, 0x7F, 0xFF):
                program.write_bytes(whole[:place] + bytes([value]) + whole[place + 1 :])
                line_of(program, address)
                told.add(problem_with("main.c:4", maps))
    assert any("debug information cannot be read" in one for one in told)
    assert not any("\n" in one for one in told)


def problem_with(asked: str, maps: MemoryMap) -> str:
    try:
        code_of_line(os.getpid(), maps, asked)
    except SourceLineError as error:
        return str(error)
    return ""
