"""A call in translation executes what it executes in single steps, and every instruction is counted."""

from __future__ import annotations

import os
import signal
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path

import pytest

from injector.block_profile import counted_call
from injector.block_profile.counted_call import CountedCall, UncountableError
from injector.block_profile.instruction_counts import (
    DynamicInstruction,
    InstructionCounts,
    shortest_way,
)
from injector.kernel_study.subject import MARK
from injector.tracing.elf import code_sections
from injector.tracing.process import MemoryMapping, Process, ProcessIdentity
from injector.tracing.ptrace import GoneError
from tests.injector.forked_calls import Standing, standing
from tests.injector.small_process import in_small_process

pytestmark = pytest.mark.usefixtures("may_inject")

FUNCTION = "__attribute__((noinline)) static"

CALLS = {
    "recursion": f"""
{FUNCTION} long fibonacci(long n) {{ return n < 2 ? n : fibonacci(n - 1) + fibonacci(n - 2); }}
double kernel(void) {{ return fibonacci(13); }}
""",
    "a switch": f"""
{FUNCTION} long one_of(int which, long x) {{
    switch (which) {{
        case 0: return x + 1; case 1: x ^= 5; case 2: return x * 3; case 3: return x - 7;
        case 4: x += 2; case 5: x -= 1; case 6: return x << 1; case 7: return x >> 1;
    }}
    return x;
}}
double kernel(void) {{
    long x = 1;
    for (int i = 0; i < 500; i++) x = one_of((i * 7 + x) & 7, x) & 0xffff;
    return x;
}}
""",
    "pointers to functions": """
#include <stdlib.h>
static int up(const void *a, const void *b) { return *(const int *)a - *(const int *)b; }
static int down(const void *a, const void *b) { return up(b, a); }
double kernel(void) {
    int list[64];
    for (int i = 0; i < 64; i++) list[i] = i * 37 % 64;
    qsort(list, 64, sizeof *list, up);
    qsort(list, 64, sizeof *list, down);
    return list[3];
}
""",
    "libraries": """
#include <math.h>
#include <stdio.h>
#include <string.h>
double kernel(void) {
    char text[200]; double sum = 0.0;
    for (int i = 1; i < 20; i++) {
        snprintf(text, sizeof text, "%d %.3f %s", i, sin(i) + pow(i, 0.3), "of several lengths");
        sum += strlen(text) + (strchr(text, '.') - text);
        memmove(text + 1, text, strlen(text));
    }
    return sum;
}
""",
    "flags that are carried on": """
double kernel(void) {
    unsigned long sum = 0;
    for (unsigned long i = 0; i < 200; i++) {
        unsigned long carried;
        __asm__ volatile("movq %1, %%rax; addq %%rax, %%rax; jmp 1f; 1: movq $0, %0; jmp 2f; 2: adcq $3, %0"
            : "=&r"(carried) : "r"(i << 57) : "rax", "cc");
        sum += carried;
        __asm__ volatile("cmpq $100, %1; jmp 3f; 3: jb 4f; incq %0; 4:" : "+r"(sum) : "r"(i) : "cc");
    }
    return sum;
}
""",
    "loops of one instruction": """
double kernel(void) {
    unsigned long sum = 0, count = 70; char from[300] = {1, 2, 3}, to[300];
    __asm__ volatile("1: addq %1, %0; loop 1b" : "+r"(sum), "+c"(count) : : "cc");
    for (int i = 0; i < 5; i++) {
        void *source = from, *target = to; count = 60 * i;
        __asm__ volatile("jrcxz 2f; incq %0; 2: rep movsb; jmp 3f; 3: jrcxz 4f; incq %0; 4:"
            : "+r"(sum), "+c"(count), "+S"(source), "+D"(target) : : "memory", "cc");
        sum += to[1];
    }
    return sum;
}
""",
    "calls of the kernel": """
#include <unistd.h>
#include <sys/syscall.h>
double kernel(void) {
    long sum = 0;
    for (int i = 0; i < 5; i++) sum += syscall(SYS_getppid) > 0;
    return sum;
}
""",
    "a jump over many calls": f"""
#include <setjmp.h>
static jmp_buf place;
{FUNCTION} void deep(int n) {{ if (n) deep(n - 1); else longjmp(place, 7); }}
double kernel(void) {{ int found = setjmp(place); if (!found) deep(20); return found; }}
""",
}

Inside = Callable[[MemoryMapping], bool]


def own_code(mapping: MemoryMapping) -> bool:
    return mapping.path.endswith("/kernel.so")


def all_code(mapping: MemoryMapping) -> bool:
    return "w" not in mapping.permissions and not mapping.name.startswith("[")


@contextmanager
def a_copy(one: Standing, inside: Inside, **how: object) -> Iterator[CountedCall]:
    copy = one.forks.copy(one.root)
    with Process(ProcessIdentity.of(copy.pid)) as process:
        pieces = [piece for piece in process.maps().code() if inside(piece)]
        code = sorted(section for piece in pieces for section in code_sections(process.pid, piece))
        yield CountedCall(copy, process, code, **how)  # type: ignore[arg-type]
    one.forks.end(copy)


def counts_of(one: Standing, inside: Inside) -> InstructionCounts:
    with a_copy(one, inside) as call:
        return InstructionCounts.of(call.run(MARK))


def is_counted(one: Standing, inside: Inside) -> Callable[[int], bool]:
    with Process(ProcessIdentity.of(one.root.pid)) as process:
        pieces = [piece for piece in process.maps().code() if inside(piece)]
    return lambda address: any(piece.start <= address < piece.end for piece in pieces)


def stepped(one: Standing, inside: Inside) -> Counter[int]:
    """How often each instruction is executed, in single steps; repetitions count as one.

    At the last of the trace the mark comes first: it is not executed.
    """
    counted = is_counted(one, inside)
    return Counter(address for address, _ in groupby(one.trace()[:-1]) if counted(address))


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.soak] * (name == "libraries")) for name in CALLS]
)
def test_every_instruction_is_counted_as_often_as_single_steps_meet_it(tmp_path: Path, name: str) -> None:
    in_small_process(counts_are_those_of_steps, tmp_path, CALLS[name])


def counts_are_those_of_steps(tmp_path: Path, kernel: str) -> None:
    with standing(tmp_path, kernel) as one:
        for inside in (own_code, all_code):
            counts = counts_of(one, inside)
            found = dict(zip(map(int, counts.addresses), map(int, counts.passes), strict=True))
            steps = stepped(one, inside)
            other = {
                hex(at): (found.get(at), steps[at]) for at in found | steps if found.get(at) != steps[at]
            }
            assert not other, other
            assert counts.executed == sum(found.values())


@pytest.mark.parametrize("name", ["recursion", "a switch", "flags that are carried on"])
def test_the_way_to_a_pass_is_that_of_the_steps(tmp_path: Path, name: str) -> None:
    in_small_process(ways_are_those_of_steps, tmp_path, CALLS[name])


def ways_are_those_of_steps(tmp_path: Path, kernel: str) -> None:
    with standing(tmp_path, kernel) as one:
        counts = counts_of(one, own_code)
        inside = is_counted(one, own_code)
        trace = [address for address, _ in groupby(one.trace()) if inside(address)]
        tried = 0
        for index in range(0, len(trace), len(trace) // 12):
            address = trace[index]
            hit = trace[: index + 1].count(address)
            drawn = DynamicInstruction(address, hit, trace.count(address))
            leaders = counts.leaders | {address}
            with a_copy(one, own_code, leaders=leaders, stops={address: [hit]}) as call:
                assert call.to_next_stop(MARK) == (address, hit)
                way = shortest_way(call.counts(), drawn)
            if way is not None:
                passes = [at for at, other in enumerate(trace) if other == way.address]
                begin = passes[way.hit - 1]
                assert begin < index
                assert trace[begin : index + 1].count(address) == way.rest
                assert way.hit + way.rest < hit
                tried += 1
        assert tried


def test_a_call_stops_at_each_pass_that_is_asked_for_and_then_ends(tmp_path: Path) -> None:
    in_small_process(stops_are_those_of_steps, tmp_path, CALLS["recursion"])


def stops_are_those_of_steps(tmp_path: Path, kernel: str) -> None:
    with standing(tmp_path, kernel) as one:
        counts, inside = counts_of(one, own_code), is_counted(one, own_code)
        trace = [address for address, _ in groupby(one.trace()) if inside(address)]
        hits: Counter[int] = Counter()
        wanted = []
        for number, address in enumerate(trace):
            hits[address] += 1
            if number % 97 == 0 or number == len(trace) - 1:
                wanted.append((address, hits[address]))
        stops: dict[int, list[int]] = {}
        for address, hit in wanted:
            stops.setdefault(address, []).append(hit)
        # A pass that never comes does not hinder the others.
        stops[trace[0]].append(hits[trace[0]] + 1)
        with a_copy(one, own_code, leaders=counts.leaders | stops.keys(), stops=stops) as call:
            assert [call.to_next_stop(MARK) for _ in wanted] == wanted
            assert call.to_next_stop(MARK) is None
            again = InstructionCounts.of(call.counts())
        assert again.passes.tolist() == counts.passes.tolist()


BY_POINTER = """
__attribute__((noinline, aligned(16))) static int callee(int x) { return 3 * x + 1; }
static int (*volatile called)(int) = callee;
double kernel(void) { int x = 1; for (int i = 0; i < 500; i++) x = called(x) & 1023; return x; }
"""


def test_a_stop_just_behind_where_many_arrive_costs_no_traps(tmp_path: Path) -> None:
    in_small_process(stops_cost_no_traps, tmp_path, BY_POINTER)


def stops_cost_no_traps(tmp_path: Path, kernel: str) -> None:
    with standing(tmp_path, kernel) as one:
        counts, inside = counts_of(one, own_code), is_counted(one, own_code)
        trace = [address for address, _ in groupby(one.trace()) if inside(address)]
        often = Counter(trace)
        first = next(at for at in trace if at in counts.leaders and at % 16 == 0 and often[at] == 500)
        second = trace[trace.index(first) + 1]
        counted_call.MOST_TRAPS = 100
        stops = {second: [often[second]]}
        with a_copy(one, own_code, leaders=counts.leaders, stops=stops) as call:
            assert call.to_next_stop(MARK) == (second, often[second])
            assert call.to_next_stop(MARK) is None


def test_a_copy_that_dies_or_hangs_is_told(tmp_path: Path) -> None:
    in_small_process(deaths, tmp_path, CALLS["recursion"])
    in_small_process(hangs, tmp_path, 'double kernel(void) { for (;;) __asm__ volatile(""); }')
    in_small_process(aborts, tmp_path, "#include <stdlib.h>\ndouble kernel(void) { abort(); }")


def deaths(tmp_path: Path, kernel: str) -> None:
    with standing(tmp_path, kernel) as one, a_copy(one, own_code) as call:
        copies = [tid for tid in one.tracees.threads if tid != one.root.tid]
        os.kill(copies[0], signal.SIGKILL)
        with pytest.raises(GoneError):
            call.run(MARK)


def hangs(tmp_path: Path, kernel: str) -> None:
    counted_call.LIMIT_S = 0.5
    with standing(tmp_path, kernel) as one, a_copy(one, own_code) as call, pytest.raises(GoneError):
        call.run(MARK)


def aborts(tmp_path: Path, kernel: str) -> None:
    with (
        standing(tmp_path, kernel) as one,
        a_copy(one, own_code) as call,
        pytest.raises(UncountableError, match="signal 6"),
    ):
        call.run(MARK)
