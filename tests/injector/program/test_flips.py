"""What the record of a flip says is what the program itself finds in its registers, bit for bit."""

from pathlib import Path

import pytest

from injector.isa.x86_64_registers import register_classes
from injector.kernel_study.results import StudyRun
from injector.program.program_injector import ProgramInjector
from services.models.faults.specification import FaultSpec
from tests.injector.program.launched import LIMIT_S, compiled, offset_of, runs_of, spec_of

PASSES = 6
GENERAL = ("rax", "rbx", "rcx", "rdx", "rsi", "rdi", *(f"r{number}" for number in range(8, 16)))
VECTORS = tuple(f"ymm{number}" for number in range(16))
MASKS = tuple(f"k{number}" for number in range(1, 8)) if "mask" in register_classes() else ()
SIZES = dict.fromkeys((*GENERAL, *MASKS, "rflags"), 8) | dict.fromkeys(VECTORS, 32)
"""What the program logs at each pass, in this order: registers, so many bytes of each."""

LOG_BYTES = sum(SIZES.values())
COPIES = {"rbx": "rax", "ymm1": "ymm0"}
"""What an instruction that is struck copies where."""


def moves(store: str) -> list[str]:
    """The instructions that load all registers from the log, or store them there; none changes a flag."""
    lines, at = [], 0
    for name, size in SIZES.items():
        move = "vmovdqu" if name in VECTORS else "kmovq" if name in MASKS else "movq"
        memory = f"{at}(%rbp)"
        if name != "rflags":
            lines.append(f"{move} %{name}, {memory}" if store else f"{move} {memory}, %{name}")
        elif store:
            lines.append(f"pushfq\\npopq {memory}")
        at += size
    return lines


def program(struck: str) -> str:
    """Sets all registers by the pass, executes an instruction, and writes out what is in them then."""
    kept = ("rbx", "rbp", "r12", "r13", "r14", "r15")
    code = [
        *(f"push %{name}" for name in kept),
        *("mov %rdi, %rbp", *moves(""), f"probe: {struck}", *moves("store"), "cld"),
        *(f"pop %{name}" for name in reversed(kept)),
        "ret",
    ]
    lines = "\n".join(f'"{line}\\n"' for line in (".globl probe", "all:", *code))
    return f"""
    #include <stdio.h>
    __asm__({lines});
    void all(unsigned char *);
    int main(void) {{
        unsigned long seed = 1;
        for (int pass = 0; pass < {PASSES}; pass++) {{
            unsigned char log[{LOG_BYTES}];
            for (int one = 0; one < {LOG_BYTES}; one++) {{
                seed = seed * 6364136223846793005UL + 1442695040888963407UL;
                log[one] = seed >> 56;
            }}
            all(log);
            fwrite(log, 1, sizeof log, stdout);
        }}
    }}
    """


def changed(golden: bytes, content: bytes) -> list[dict[str, int]]:
    """Of each pass the registers that the program logged otherwise, and which of their bits."""
    assert len(content) == len(golden) == PASSES * LOG_BYTES
    found, at = [], 0
    for _ in range(PASSES):
        of_pass: dict[str, int] = {}
        for name, size in SIZES.items():
            was, now = (int.from_bytes(one[at : at + size], "little") for one in (golden, content))
            of_pass |= {name: was ^ now} if was != now else {}
            at += size
        found.append(of_pass)
    return found


def expected(run: StudyRun) -> list[dict[str, int]]:
    """What the record says that the program is to find."""
    record = run.injection
    assert run.point is not None
    assert (record.status, record.after) == ("injected", record.read_back)
    mask = sum(1 << bit for bit in record.bits)
    assert mask == int(record.before, 16) ^ int(record.after, 16)
    of_pass = {record.register_name: mask}
    if record.operand == "source":
        of_pass[COPIES[record.register_name]] = mask
    return [of_pass if number == run.point.hit else {} for number in range(1, PASSES + 1)]


@pytest.mark.parametrize("runs_each", [15, pytest.param(100, marks=pytest.mark.soak)])
@pytest.mark.parametrize(
    ("struck", "fault"),
    [
        ("nop", {"registers": GENERAL, "bits": 2}),
        ("nop", {"registers": VECTORS, "bits": 3}),
        ("nop", {"registers": ("rflags",)}),
        pytest.param("nop", {"registers": MASKS}, marks=pytest.mark.skipif(not MASKS, reason="no masks")),
        ("movq %rbx, %rax", {"mask": "byte"}),
        ("vmovapd %ymm1, %ymm0", {}),
        ("vaddpd %ymm2, %ymm1, %ymm0", {"operand": "destination", "field": "exponent"}),
        ("addq %rdx, %rcx", {"operand": "destination"}),
    ],
)
def test_the_program_finds_the_flip(
    tmp_path: Path, struck: str, fault: dict[str, object], runs_each: int
) -> None:
    file = compiled(tmp_path, program(struck), "logs")
    spec = spec_of([file], module="logs", address=offset_of(file, "probe"))
    asked = FaultSpec.model_validate({"target": "logs", "scope": "thread", **fault})
    with runs_of(spec) as runs:
        injector = ProgramInjector(runs, LIMIT_S)
        _, points = injector.draw(asked, 1, range(runs_each))
        made = 0
        for _, run in injector.run(points, asked, 1):
            content, golden = (folder / "stdout" for folder in (runs._of_run, runs._of_golden))
            assert changed(golden.read_bytes(), content.read_bytes()) == expected(run)
            assert run.injection.register_name in (asked.registers or SIZES)
            made += 1
    assert made == runs_each
