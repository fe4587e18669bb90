"""The drawn pass is reached by each of four ways, and by no other pass."""

import os
from collections.abc import Mapping
from pathlib import Path

import pytest

from injector.kernel_study.results import StudyRun
from injector.program.approach import MOST_BY_BREAKPOINT
from injector.program.profile import FEW_PASSES
from services.models.faults.specification import FaultSpec
from tests.injector.program.launched import COUNTS, compiled, injector_of, offset_of, spec_of

READ = {"operand": "source", "register_class": "gpr"}


def struck(
    tmp_path: Path, place: str, passes: int, draws: int, fields: Mapping[str, object] = READ
) -> list[StudyRun]:
    program = compiled(tmp_path, COUNTS, "counts")
    spec = spec_of([program, str(passes)], module="counts", address=offset_of(program, place))
    fault = FaultSpec.model_validate({"target": "counts", "scope": "thread", **fields})
    with injector_of(spec) as injector:
        length, points = injector.draw(fault, 5, range(draws))
        assert length.scope == passes
        return [run for _, run in injector.run(points, fault, 5)]


def hit_of(run: StudyRun) -> int:
    assert run.point is not None
    return run.point.hit


def test_a_breakpoint_and_a_countdown_lead_to_the_pass(tmp_path: Path) -> None:
    runs = struck(tmp_path, "probe", 3 * FEW_PASSES, 24)
    ways = {bool(run.point and run.point.counted_at) for run in runs}
    assert ways == {True, False}
    assert [int(run.injection.before, 16) for run in runs] == [hit_of(run) for run in runs]
    assert {run.result for run in runs} == {"sdc"}


def test_a_late_pass_is_counted_in_the_program(tmp_path: Path) -> None:
    passes = 30_000_000
    (run,) = struck(tmp_path, "probe", passes, 1)
    assert hit_of(run) > passes // 100
    assert int(run.injection.before, 16) == hit_of(run)


def test_where_no_jump_fits_in_the_program_runs_in_translation(tmp_path: Path) -> None:
    passes = 50 * MOST_BY_BREAKPOINT
    runs = struck(tmp_path, "narrow", passes, 3, {"registers": ("rcx",)})
    assert [run.point and run.point.counted_at for run in runs] == [0, 0, 0]
    assert [int(run.injection.before, 16) for run in runs] == [passes - hit_of(run) + 1 for run in runs]


def test_a_short_jump_leads_by_way_of_bytes_that_are_not_executed(tmp_path: Path) -> None:
    passes = 50 * MOST_BY_BREAKPOINT
    runs = struck(tmp_path, "tight", passes, 3)
    assert all(run.point and run.point.by_way_of for run in runs)
    assert [int(run.injection.before, 16) for run in runs] == [passes - hit_of(run) + 1 for run in runs]


@pytest.mark.parametrize("options", [("-pthread",), ("-pthread", "-static")])
def test_passes_of_all_threads_count(tmp_path: Path, options: tuple[str, ...]) -> None:
    source = """
    #include <pthread.h>
    #include <stdio.h>
    static long passes;
    static void *work(void *nothing) {
        for (int at = 0; at < 1000; at++) {
            passes += 1;
            __asm__ volatile(".globl probe\\nprobe: mov %0, %%rax\\nmov %%rax, %%rcx"
                             :: "r"(passes) : "rax", "rcx");
        }
        return nothing;
    }
    int main(void) {
        pthread_t one;
        for (int at = 0; at < 5; at++) { pthread_create(&one, 0, work, 0); pthread_join(one, 0); }
        printf("%ld\\n", passes);
    }
    """
    program = compiled(tmp_path, source, "threads", *options)
    spec = spec_of([program], module="threads", address=offset_of(program, "probe"))
    fault = FaultSpec(target="threads", scope="thread", operand="source", register_class="gpr")
    with injector_of(spec) as injector:
        length, points = injector.draw(fault, 1, range(8))
        runs = [run for _, run in injector.run(points, fault, 1)]
    assert length.scope == 5000
    assert [int(run.injection.before, 16) for run in runs] == [hit_of(run) for run in runs]


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="one processor")
def test_passes_of_threads_that_ask_for_several_processors_count(tmp_path: Path) -> None:
    source = """
    #define _GNU_SOURCE
    #include <pthread.h>
    #include <sched.h>
    static int ready;
    static void *work(void *processor) {
        cpu_set_t one;
        CPU_ZERO(&one); CPU_SET((long)processor, &one);
        if (sched_setaffinity(0, sizeof one, &one)) return processor;
        __atomic_add_fetch(&ready, 1, __ATOMIC_SEQ_CST);
        while (__atomic_load_n(&ready, __ATOMIC_SEQ_CST) < 2) sched_yield();
        for (long at = 0; at < 3000000; at++)
            __asm__ volatile(".globl probe\\nprobe: mov %0, %%rax\\nmov %%rax, %%rcx"
                             :: "r"(at) : "rax", "rcx");
        return 0;
    }
    int main(void) {
        pthread_t threads[2];
        long processors[2] = {FIRST, SECOND};
        for (int at = 0; at < 2; at++) pthread_create(&threads[at], 0, work, (void *)processors[at]);
        for (int at = 0; at < 2; at++) pthread_join(threads[at], 0);
    }
    """
    first, second, *_ = sorted(os.sched_getaffinity(0))
    places = (f"-DFIRST={first}", f"-DSECOND={second}")
    program = compiled(tmp_path, source, "processors", "-pthread", *places)
    spec = spec_of([program], module="processors", address=offset_of(program, "probe"))
    fault = FaultSpec(target="processors", scope="thread", model="none")
    with injector_of(spec) as injector:
        length, points = injector.draw(fault, 1, range(100))
        last = max(points, key=lambda point: point.hit)
        ((_, run),) = injector.run([last], fault, 1)
    assert length.scope == 6_000_000
    assert last.hit > 5_700_000
    assert run.result == "benign", run.cause


CROWDED = """
#include <stdio.h>
int main(void) {
    unsigned long sum = 0, odd = 0;
    for (unsigned long i = 1; i <= 2000; i++) {
        __asm__ volatile("mov $3, %%ecx\\n.globl crowded\\ncrowded: mov %1, %%rax\\n"
                         "1: dec %%rcx\\njnz 1b\\nadd %%rax, %0"
                         : "+r"(sum) : "r"(i) : "rax", "rcx", "cc");
        __asm__ volatile(".fill 130,1,0x90\\nmov $3, %%ecx\\njmp 3f\\n3:\\n"
                         ".globl walled\\nwalled: mov %1, %%rax\\n"
                         "1: dec %%rcx\\njnz 1b\\nadd %%rax, %0\\n.fill 130,1,0x90"
                         : "+r"(sum) : "r"(i) : "rax", "rcx", "cc");
        __asm__ volatile("test $1, %b2\\njnz joined\\nxor %%ecx, %%ecx\\nmov $0, %%ecx\\n"
                         ".globl joined\\njoined: mov %2, %%rax\\n"
                         "seto %%cl\\nadd %%rax, %0\\nadd %%rcx, %1"
                         : "+r"(sum), "+r"(odd) : "r"(i) : "rax", "rcx", "cc");
    }
    printf("%lu %lu\\n", sum, odd);
}
"""


@pytest.mark.parametrize("place", ["crowded", "joined", "walled"])
def test_passes_are_counted_where_nobody_arrives_in_another_way(tmp_path: Path, place: str) -> None:
    program = compiled(tmp_path, CROWDED, "crowded")
    spec = spec_of([program], module="crowded", address=offset_of(program, place))
    fault = FaultSpec(target="crowded", scope="thread", operand="source", register_class="gpr")
    with injector_of(spec) as injector:
        length, points = injector.draw(fault, 5, range(8))
        runs = [run for _, run in injector.run(points, fault, 5)]
    assert length.scope == 2000
    assert [int(run.injection.before or "0", 16) for run in runs] == [hit_of(run) for run in runs]
