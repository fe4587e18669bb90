"""Counted runs: as many passes as a run in single steps makes, and the same output."""

from collections import Counter
from itertools import groupby
from pathlib import Path

import numpy as np
import pytest

from injector.block_profile.counted_call import UncountableError
from injector.isa.host import decode
from injector.program.comparison import UnsuitableProgramError
from injector.program.counted_program import CountedProgram
from injector.program.spec import ProgramSpec
from injector.tracing import ptrace
from tests.injector.program.launched import COUNTS, LIMIT_S, compiled, injector_of, runs_of, spec_of

BUSY = """
#include <pthread.h>
#include <setjmp.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/wait.h>
#include <unistd.h>
static sigjmp_buf back;
static volatile int alarms;
static void on_fault(int number) { siglongjmp(back, number); }
static void on_alarm(int number) { alarms += number == SIGALRM; }
static void *work(void *given) {
    volatile long sum = 0;
    for (long at = 0; at < 20000; at++) sum += at * (long)given;
    return (void *)sum;
}
int main(void) {
    pthread_t threads[200];
    long sum = 0;
    signal(SIGSEGV, on_fault);
    signal(SIGALRM, on_alarm);
    if (!sigsetjmp(back, 1)) *(volatile int *)8 = 1; else puts("a fault was caught");
    alarm(1);
    while (!alarms) ;
    pid_t child = fork();
    if (!child) { execlp("echo", "echo", "a child", (char *)0); _exit(1); }
    waitpid(child, 0, 0);
    child = vfork();
    if (!child) _exit(7);
    int status;
    waitpid(child, &status, 0);
    fflush(stdout);
    if (system("echo by a shell")) return 1;
    for (long at = 0; at < 200; at++) pthread_create(&threads[at], 0, work, (void *)at);
    for (int at = 0; at < 200; at++) { void *made; pthread_join(threads[at], &made); sum += (long)made; }
    printf("%d %ld\\n", WEXITSTATUS(status), sum);
}
"""

THROWS = """
#include <cstdio>
#include <map>
#include <stdexcept>
static int deep(int n) { if (!n) throw std::runtime_error("thrown"); return deep(n - 1) + 1; }
int main() {
    std::map<int, int> seen;
    for (int at = 0; at < 50; at++) try { seen[at] = deep(at); } catch (std::exception &e) { seen[at] = -at; }
    std::printf("%d\\n", seen[49]);
}
"""


FLAGS = """
#include <stdio.h>
int main(void) {
    unsigned long seen = 0;
    for (int at = 0; at < 4; at++) {
        unsigned left = at & 1 ? 0x7fffffff : 0xffffffff, low = at & 2 ? 1 : 0x80000001;
        unsigned overflow = 0, others = 0;
        __asm__ volatile("add %3, %2\\njmp 1f\\n1: seto %b0\\nlahf\\nmovzbl %%ah, %1"
                         : "+q"(overflow), "=r"(others), "+r"(left) : "r"(low) : "rax", "cc");
        seen = seen * 1000 + overflow * 256 + others;
    }
    printf("%lu\\n", seen);
}
"""


PAIRS = """
#include <signal.h>
#include <stdio.h>
#include <sys/mman.h>
#include <sys/wait.h>
#include <unistd.h>
static volatile int *seen;
static void on_signal(int number) { seen[number == SIGUSR2]++; }
static unsigned long twice(unsigned long at) { return 2 * at; }
static unsigned long thrice(unsigned long at) { return 3 * at; }
static unsigned long (*volatile const of[2])(unsigned long) = {twice, thrice};
int main(void) {
    seen = mmap(0, 4096, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    signal(SIGUSR1, on_signal);
    signal(SIGUSR2, on_signal);
    pid_t sender = fork();
    for (int sent = 1; !sender; sent++) {
        if (sent > 200 || kill(getppid(), SIGUSR1) || kill(getppid(), SIGUSR2)) _exit(0);
        for (int at = 0; seen[0] < sent || seen[1] < sent; at++) if (usleep(1000), at > 5000) _exit(1);
    }
    unsigned long wrong = 0;
    int status;
    for (unsigned long at = 1; at & 1023 || !waitpid(sender, &status, WNOHANG); at++)
        wrong += of[at & 1](at) != (2 + (at & 1)) * at;
    printf("%lu %d %d %d\\n", wrong, status, seen[0], seen[1]);
}
"""
"""Two signals at a time, while calls by address are under way; each is awaited."""


def stepped(spec: ProgramSpec) -> Counter[int]:
    """The passes of a run in single steps; a repeated instruction counts once."""
    with runs_of(spec) as runs, runs.launch() as program:
        main, addresses = program.threads[program.pid], []
        while True:
            passed, report = ptrace.trace(program.pid, 10_000_000)
            addresses += passed
            assert report is not None
            if report.kind == "gone":
                break
            assert report.kind == "filtered"
            program.give_random_bytes(main)
        program.threads.clear()
    return Counter(address for address, _ in groupby(addresses))


def counted(spec: ProgramSpec) -> tuple[Counter[int], list[bytes]]:
    with runs_of(spec) as runs, runs.launch(counted=True) as program:
        made = CountedProgram(program)
        blocks = made.run(LIMIT_S)
    passes: Counter[int] = Counter()
    for instructions, often in zip(blocks.instructions, blocks.passes.tolist(), strict=True):
        for address in instructions if often else ():
            passes[address] += often
    return passes, made.translations.sources


@pytest.mark.parametrize("options", [(), ("-static",), ("-no-pie", "-s")])
def test_a_counted_run_passes_each_instruction_as_often_as_a_stepped_one(
    tmp_path: Path, options: tuple[str, ...]
) -> None:
    spec = spec_of([compiled(tmp_path, COUNTS, "counts", *options), "40"])
    passes, _ = counted(spec)
    true = stepped(spec)
    # The run in single steps ends within the system call that ends the program.
    assert passes.keys() == true.keys()
    apart = {hex(one): (passes[one], true[one]) for one in true if passes[one] != true[one]}
    # In single steps an instruction that jumps to itself looks like a repeated one.
    assert set(apart.values()) == {(40, 1)}


def test_counts_repeat(tmp_path: Path) -> None:
    spec = spec_of([compiled(tmp_path, COUNTS, "counts"), "1000"])
    first, _ = counted(spec)
    assert counted(spec)[0] == first
    assert max(first.values()) >= 1000


@pytest.mark.parametrize("options", [("-pthread",), ("-pthread", "-static"), ("-pthread", "-no-pie", "-s")])
def test_threads_signals_and_children_run_as_without_us(tmp_path: Path, options: tuple[str, ...]) -> None:
    with injector_of(spec_of([compiled(tmp_path, BUSY, "busy", *options)])) as injector:
        profile = injector.counted()  # raises if the output is another one
    assert profile.counts.executed > 200 * 20_000


def test_signals_that_come_together_disturb_no_call(tmp_path: Path) -> None:
    with injector_of(spec_of([compiled(tmp_path, PAIRS, "pairs")])) as injector:
        assert injector.counted().counts.executed > 10_000  # raises if the output is another one


def test_flags_outlive_the_beginning_of_a_block(tmp_path: Path) -> None:
    with injector_of(spec_of([compiled(tmp_path, FLAGS, "flags")])) as injector:
        assert injector.counted().counts.executed > 10_000  # raises if the output is another one


def test_exceptions_find_their_way(tmp_path: Path) -> None:
    source = tmp_path / "throws.cc"
    source.write_text(THROWS)
    program = compiled(tmp_path, "", "none", "-x", "c++", str(source), "-lstdc++")
    with injector_of(spec_of([program])) as injector:
        assert injector.counted().counts.executed > 10_000


def test_a_program_that_becomes_another_one_is_refused() -> None:
    with (
        injector_of(spec_of(["sh", "-c", "exec echo hello"])) as injector,
        pytest.raises(UnsuitableProgramError, match="executes another one in its place"),
    ):
        injector.counted()


def test_code_that_is_made_at_run_time_is_refused(tmp_path: Path) -> None:
    source = """
    #include <string.h>
    #include <sys/mman.h>
    int main(void) {
        void *code = mmap(0, 4096, 7, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
        memcpy(code, "\\xb8\\x00\\x00\\x00\\x00\\xc3", 6);
        return ((int (*)(void))code)();
    }
    """
    with (
        injector_of(spec_of([compiled(tmp_path, source, "makes")])) as injector,
        pytest.raises(UnsuitableProgramError, match="makes code while it runs"),
    ):
        injector.counted()


def test_what_does_not_end_is_given_up() -> None:
    spec = spec_of(["sleep", "1000"])
    with (
        runs_of(spec) as runs,
        runs.launch(counted=True) as program,
        pytest.raises(UncountableError, match="did not come to its end"),
    ):
        CountedProgram(program).run(0.5)


def test_what_was_counted_can_be_decoded(tmp_path: Path) -> None:
    passes, code = counted(spec_of([compiled(tmp_path, COUNTS, "counts"), "10"]))
    assert len(code) > 100
    assert all(decode(one[:15], 0).code for one in code)
    assert np.all(np.array(list(passes.values())) > 0)
