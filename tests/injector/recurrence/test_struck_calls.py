"""Small programs in whose calls a fault recurs: what they compute tells which executions were struck how."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from itertools import accumulate, takewhile
from pathlib import Path

import pytest

from injector.isa.x86_64_registers import register_classes
from injector.recurrence.schedule import chance, gaps
from injector.recurrence.struck_calls import StrikeTally, StruckCalls
from injector.tracing.elf import code_sections
from injector.tracing.process import Process, ProcessIdentity
from services.models.faults.specification import FaultSpec
from services.models.outcome import STRIKES_KEPT, InjectionRecord
from tests.injector.conftest import may_inject  # noqa: F401 - wrong changes are tried without conftest.py
from tests.injector.forked_calls import Standing, standing
from tests.injector.small_process import in_small_process

pytestmark = pytest.mark.usefixtures("may_inject")

TIMES = 300
"""Executions: of a permanent defect the first are struck by the injector, and the others by code."""

assert TIMES > 2 * STRIKES_KEPT

_MARKED = """
#include <signal.h>
#include <string.h>
long marks[4], out[{times}];
static long one(long i);
double kernel(void) {{
    marks[0] = 1; marks[1] = 5; marks[3] = 1000000000;
    raise(SIGURG);
    long i, sum = 0;
    for (i = 0; i < {times}; i++) {{ out[i] = one(i); sum += out[i]; }}
    marks[0] = 0;
    raise(SIGURG);
    return sum;
}}
"""

Body = Callable[[Path, str], None]


def program(body: str, times: int = TIMES) -> str:
    """A kernel of a call whose result is the sum of ``one(i)`` over so many ``i``."""
    return _MARKED.format(times=times) + f"__attribute__((noinline)) static long one(long i) {{ {body} }}"


def assembly(code: str) -> str:
    """The body of such a function in assembly: i is in rsi, the result in rdi."""
    clobbered = '"rax", "rcx", "rdx", "r9", "xmm3", "xmm9", "memory", "cc"'
    return f'long r = 0; __asm__ volatile("{code}" : "+D"(r), "+S"(i) : : {clobbered}); return r;'


class Struck:
    """What came of a call: the records, the sum that it returned, and how often it was struck."""

    def __init__(self, one: Standing, folder: Path, fault: FaultSpec) -> None:
        library = ctypes.CDLL(str(folder / "kernel.so"))
        marks = ctypes.addressof((ctypes.c_long * 4).in_dll(library, "marks"))
        self.records: list[InjectionRecord] = []
        copy = one.forks.copy(one.root)
        with Process(ProcessIdentity.of(copy.pid)) as process:
            calls = StruckCalls(
                one.tracees,
                copy,
                process,
                fault,
                "node",
                7,
                marks,
                self.records.append,
                StrikeTally(),
                own_code=own_code,
            )
            calls.follow()
        self.result = one.result(copy)
        self.strikes = sum(record.strikes for record in self.records)


def own_code(_: FaultSpec, process: Process) -> list[tuple[int, int]]:
    pieces = [piece for piece in process.maps().code() if piece.path.endswith("/kernel.so")]
    return sorted(section for piece in pieces for section in code_sections(process.pid, piece))


def defect(opcodes: str, **more: object) -> FaultSpec:
    given = {"target": "pid", "recurrence": "permanent", "opcodes": opcodes.split("+"), **more}
    return FaultSpec.model_validate(given)


def total(of: Callable[[int], int], times: int = TIMES) -> int:
    return sum(of(i) for i in range(times))


CASES: dict[str, tuple[str, dict[str, object], Callable[[int], int]]] = {
    "a product of floats changes its sign": (
        "volatile double x = i; return (long)(x * 3.0);",
        {"opcodes": "mulsd", "bit_numbers": [63]},
        lambda i: -3 * i,
    ),
    "a general register": (
        assembly("imulq $3,%%rsi,%%r9; movq %%r9,%%rdi"),
        {"opcodes": "imul", "bit_numbers": [4], "register_class": "gpr"},
        lambda i: 3 * i ^ 16,
    ),
    "a register that the code needs": (
        assembly("leaq 1(%%rsi),%%rcx; movq %%rcx,%%rdi"),
        {"opcodes": "lea", "bit_numbers": [5]},
        lambda i: i + 1 ^ 32,
    ),
    "another register that the code needs": (
        assembly("leaq 1(%%rsi),%%rax; movq %%rax,%%rdi"),
        {"opcodes": "lea", "bit_numbers": [5]},
        lambda i: i + 1 ^ 32,
    ),
    "the second byte of a register": (
        assembly("xorl %%edx,%%edx; incb %%dh; leaq (%%rdx,%%rsi),%%rdi"),
        {"opcodes": "inc", "bit_numbers": [7], "register_class": "gpr"},
        lambda i: 0x8100 + i,
    ),
    "flags outlive a strike": (
        assembly("cmpq $150,%%rsi; leaq 2(%%rsi),%%rdx; adcq $0,%%rdx; movq %%rdx,%%rdi"),
        {"opcodes": "lea", "bit_numbers": [3]},
        lambda i: (i + 2 ^ 8) + (i < 150),
    ),
    "a flag": (
        assembly("btq $0,%%rsi; setc %%dil"),
        {"opcodes": "bt", "bit_numbers": [0], "register_class": "flags"},
        lambda i: 1 - i % 2,
    ),
    "a source": (
        assembly("movq %%rsi,%%rdx; imulq $3,%%rdx,%%rdi"),
        {"opcodes": "imul", "operand": "source", "bit_numbers": [2], "register_class": "gpr"},
        lambda i: 3 * (i ^ 4),
    ),
    "the upper part of a vector": (
        assembly(
            "vmovq %%rsi,%%xmm3; vpbroadcastq %%xmm3,%%ymm3; vpaddq %%ymm3,%%ymm3,%%ymm9;"
            "vextracti128 $1,%%ymm9,%%xmm9; vmovq %%xmm9,%%rdi; vzeroupper"
        ),
        {"opcodes": "vpaddq", "bit_numbers": [131]},
        lambda i: 2 * i ^ 8,
    ),
    "a mask register": (
        assembly("kmovw %%esi,%%k1; knotw %%k1,%%k2; kmovw %%k2,%%edi"),
        {"opcodes": "knotw", "bit_numbers": [1]},
        lambda i: (~i & 0xFFFF) ^ 2,
    ),
}
NEEDS_AVX512 = {"the upper part of a vector", "a mask register"}


def test_a_defective_unit_spoils_each_execution_in_the_same_bits(tmp_path: Path) -> None:
    in_small_process(defective_units, tmp_path)


def defective_units(folder: Path) -> None:
    for number, name in enumerate(CASES):
        if name in NEEDS_AVX512 and "mask" not in register_classes():
            continue
        own = folder / str(number)
        own.mkdir()
        defective_unit(own, name)


def defective_unit(folder: Path, name: str) -> None:
    body, what, right = CASES[name]
    fault = defect(**what)  # type: ignore[arg-type]
    with standing(folder, program(body)) as one:
        found = Struck(one, folder, fault)
        (record,) = found.records
        assert (record.status, record.reason, record.invocation) == ("injected", "", 5), name
        assert record.strikes == TIMES, name
        assert len(record.struck) == STRIKES_KEPT
        assert found.result == total(right), (name, found.result, total(right))
        for strike in record.struck:
            assert strike.bits == what["bit_numbers"]
            mask = sum(1 << bit for bit in strike.bits)
            assert int(strike.after, 16) == int(strike.read_back, 16) == int(strike.before, 16) ^ mask
            assert strike.instruction.split()[0] == what["opcodes"]


PATTERNS: dict[
    str, tuple[str, dict[str, object], Callable[[int], bool], Callable[[int], int], Callable[[int], int]]
] = {
    "a destination, by the integer that is read": (
        assembly("imulq $3,%%rsi,%%r9; movq %%r9,%%rdi"),
        {"opcodes": "imul", "register_class": "gpr", "where_set": [1], "where_clear": [0, 63]},
        lambda i: i % 4 == 2,
        lambda i: 3 * i ^ 32,
        lambda i: 3 * i,
    ),
    "a source, in registers that the code needs": (
        assembly("movq %%rsi,%%rcx; imulq $3,%%rcx,%%rax; movq %%rax,%%rdi"),
        {"opcodes": "imul", "operand": "source", "register_class": "gpr", "where_set": [2]},
        lambda i: bool(i & 4),
        lambda i: 3 * (i ^ 32),
        lambda i: 3 * i,
    ),
    "the second byte of a register": (
        assembly("movq %%rsi,%%rdx; movb %%dl,%%dh; incb %%dh; movzbl %%dh,%%edi"),
        {"opcodes": "inc", "register_class": "gpr", "where_clear": [0]},
        lambda i: i % 2 == 0,
        lambda i: i + 1 & 255 ^ 32,
        lambda i: i + 1 & 255,
    ),
    "a product of floats, by an exponent that is odd": (
        "volatile double x = i; return (long)(x * 3.0);",
        {"opcodes": "mulsd", "where_set": [52], "bit_numbers": [63]},
        lambda i: i > 0 and (1022 + i.bit_length()) % 2 == 1,
        lambda i: -3 * i,
        lambda i: 3 * i,
    ),
    "flags outlive it": (
        assembly(
            "cmpq $150,%%rsi; leaq 2(%%rsi),%%rdx; bswapq %%rdx; bswapq %%rdx;adcq $0,%%rdx; movq %%rdx,%%rdi"
        ),
        {"opcodes": "bswap", "where_set": [56]},
        lambda i: i % 2 == 1,
        lambda i: (i + 2 ^ 32) + (i < 150),
        lambda i: i + 2 + (i < 150),
    ),
    "bits that the operand has not": (
        assembly("imull $3,%%esi,%%r9d; movl %%r9d,%%edi"),
        {"opcodes": "imul", "register_class": "gpr", "where_clear": [32]},
        lambda _: False,
        lambda i: 3 * i,
        lambda i: 3 * i,
    ),
}
"""Program, fault, whether it strikes in i, what comes of it then, and else."""


def test_a_defect_shows_only_where_an_operand_is_as_asked(tmp_path: Path) -> None:
    in_small_process(defects_by_operand, tmp_path)


def defects_by_operand(folder: Path) -> None:
    for number, (name, (body, what, strikes, spoiled, right)) in enumerate(PATTERNS.items()):
        own = folder / str(number)
        own.mkdir()
        fault = defect(**{"bit_numbers": [5], **what})  # type: ignore[arg-type]
        with standing(own, program(body)) as one:
            found = Struck(one, own, fault)
        expected = [spoiled(i) if strikes(i) else right(i) for i in range(TIMES)]
        assert found.strikes == sum(map(strikes, range(TIMES))), name
        assert found.result == sum(expected), (name, found.result, sum(expected))


def test_bits_of_a_defect_are_drawn_once(tmp_path: Path) -> None:
    in_small_process(drawn_once, tmp_path)


def drawn_once(folder: Path) -> None:
    body = "volatile double x = i, y = i; return (long)(x * 3.0) + (long)(y * 5.0);"
    with standing(folder, program(body)) as one:
        found = [Struck(one, folder, defect("mulsd", seed=seed)).records[0] for seed in (1, 1, 2, 3)]
        assert found[0].struck == found[1].struck
        bits = [{tuple(strike.bits) for strike in record.struck} for record in found]
        assert all(len(one) == 1 for one in bits)
        assert len({strike.offset for strike in found[0].struck}) == 2
        assert len({next(iter(one)) for one in bits}) > 1


def test_without_a_flip_a_call_is_what_it_is(tmp_path: Path) -> None:
    in_small_process(nothing_is_flipped, tmp_path)


def nothing_is_flipped(folder: Path) -> None:
    with standing(folder, program("volatile double x = i; return (long)(x * 3.0);")) as one:
        for opcodes in ("mulsd", "sqrtsd"):
            found = Struck(one, folder, defect(opcodes, model="none"))
            assert found.result == total(lambda i: 3 * i)
            assert [record.status for record in found.records] == ["not_activated"]


def changed(results: Sequence[int], right: Callable[[int], int]) -> list[int]:
    return [1 + i for i, result in enumerate(results) if result != right(i)]


def expected(fault: FaultSpec, times: int) -> list[int]:
    """The executions, from 1, that are to be struck in the call, which takes a second."""
    drawn = accumulate(gaps(fault, 7, 5, chance(fault, 10**9, times)))
    return list(takewhile(lambda at: at <= times, drawn))


def test_an_intermittent_fault_strikes_the_drawn_executions(tmp_path: Path) -> None:
    in_small_process(intermittent, tmp_path)


def intermittent(folder: Path) -> None:
    """Each is told by a power of two of its own."""
    times = 40
    body = (
        'long r; __asm__ volatile("imulq $1,%1,%0" : "=r"(r) : "r"(0L) : "cc"); return r != 0 ? 1L << i : 0;'
    )
    fault = FaultSpec(
        target="pid",
        recurrence="intermittent",
        probability=0.3,
        opcodes=("imul",),
        operand="destination",
        register_class="gpr",
        seed=4,
    )
    with standing(folder, program(body, times)) as one:
        found = Struck(one, folder, fault)
        drawn = expected(fault, times)
        assert found.result == sum(1 << at - 1 for at in drawn)
        assert found.strikes == len(drawn) > 5
        struck = found.records[0].struck
        assert len({tuple(strike.bits) for strike in struck}) > 3
        assert all(strike.after == strike.read_back != strike.before for strike in struck)


def test_upsets_come_at_their_part_of_the_call(tmp_path: Path) -> None:
    in_small_process(upsets_in_a_call, tmp_path)


def upsets_in_a_call(folder: Path) -> None:
    times = 40
    body = (
        'long r; __asm__ volatile("imulq $1,%1,%0" : "=r"(r) : "r"(0L) : "cc"); return r != 0 ? 1L << i : 0;'
    )
    fault = FaultSpec(
        target="pid",
        recurrence="rate",
        rate_hz=12.0,
        opcodes=("imul",),
        operand="destination",
        register_class="gpr",
    )
    with standing(folder, program(body, times)) as one:
        found = Struck(one, folder, fault)
        drawn = expected(fault, times)
        assert found.result == sum(1 << at - 1 for at in drawn)
        assert found.strikes == len(drawn) > 5
        struck = found.records[0].struck
        assert [one.virtual_time_ns for one in struck] == [round(at / times * 1e9) for at in drawn]


def test_a_node_that_dies_of_a_strike_has_told_it(tmp_path: Path) -> None:
    in_small_process(deadly, tmp_path)


def deadly(folder: Path) -> None:
    body = assembly("leaq -8(%%rsp),%%rdx; movq (%%rdx),%%rdi")
    with standing(folder, program(body)) as one:
        found = Struck(one, folder, defect("lea", bit_numbers=[62]))
        assert found.result is None
        assert found.strikes >= 1
        assert found.records[0].status == "injected"


EXCEPTION = """
#include <stdexcept>
extern "C" {
#include <signal.h>
long marks[4];
}
__attribute__((noinline)) static double deep(int n, double x) {
    struct Count { double *at; ~Count() { *at += 1; } };
    static double unwound;
    Count count{&unwound};
    if (!n) throw x + unwound;
    return deep(n - 1, x * 1.5) + 1;
}
extern "C" double kernel(void) {
    double sum = 0;
    marks[0] = 1;
    raise(SIGURG);
    for (int i = 0; i < 20; i++)
        try { sum += deep(i, 1.0); } catch (double thrown) { sum += thrown; }
    marks[0] = 0;
    raise(SIGURG);
    return sum;
}
"""


def test_exceptions_pass_through_the_code(tmp_path: Path) -> None:
    in_small_process(exceptions, tmp_path)


def exceptions(folder: Path) -> None:
    with standing(folder, EXCEPTION, ".cpp") as one:
        right = one.result(one.forks.copy(one.root))
        found = Struck(one, folder, defect("mulsd", model="none"))
        assert found.result == right is not None


def test_records_name_the_instruction(tmp_path: Path) -> None:
    in_small_process(named, tmp_path)


def named(folder: Path) -> None:
    with standing(folder, program("volatile double x = i; return (long)(x * 3.0);")) as one:
        (record,) = Struck(one, folder, defect("mulsd", bit_numbers=[3])).records
        assert record.model == "bitflip"
        assert record.scope == "kernel"
        assert record.module == record.struck[0].module == "kernel.so"
        assert record.symbol == record.struck[0].symbol == "one"
        assert record.register_name == record.struck[0].register_name
        assert record.precision == "exact"
