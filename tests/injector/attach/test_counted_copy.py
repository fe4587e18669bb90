"""Calls too long to step through are struck at instructions drawn uniformly; the process hears nothing."""

import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from scipy import stats

from injector.attach.approach import AttachTarget
from injector.attach.function_calls import CalledFunction
from injector.attach.injection import ProcessInjection, inject_into
from injector.attach.permission import admit
from injector.tracing.symbols import variants_of
from services.models.faults.specification import FaultSpec
from services.runtime.rng import generator
from tests.conftest import wait_until
from tests.injector.cpp_program import compiled_cpp, running_program

pytestmark = pytest.mark.usefixtures("may_inject")

ROUNDS = 30_000
"""So many rounds of 332 instructions take longer than what is stepped through: ten million."""

STRIKES = 200
ROOT = Path(__file__).parents[3]
_SOURCE = """
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <linux/filter.h>
#include <linux/seccomp.h>
#include <fcntl.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/wait.h>
#include <unistd.h>
asm(R"(
    .text
    .globl lengthy
    .type lengthy, @function
lengthy:
    xor %eax, %eax
    xor %edx, %edx
    mov %rdi, %rcx
    shl $4, %rcx
0:  mov $16, %r9d
1:  add %rcx, %rax
    lea 1(%rax,%rdx), %rdx
    dec %rcx
    dec %r9
    jnz 1b
    test %rcx, %rcx
    jnz 0b
    lea (%rdi,%rdi,2), %rcx
    shl $4, %rcx
2:  mov $16, %r9d
3:  xor %rcx, %rax
    add %rax, %rdx
    dec %rcx
    dec %r9
    jnz 3b
    test %rcx, %rcx
    jnz 2b
    add %rdx, %rax
    ret
    .size lengthy, . - lengthy
)");
#define CALLED extern "C" __attribute__((noinline))
extern "C" long lengthy(long n);
int *shared, out;
CALLED long writes(long n) { long r = lengthy(n); write(out, "x", 1); return r + 1; }
CALLED long shares(long n) { long r = lengthy(n); *shared += 1; return r + 1; }
CALLED long waits(long n) { long r = lengthy(n); usleep(1); return r + 1; }
void heard(int) { _exit(3); }
int main(int, char **arguments) {
    prctl(PR_SET_PTRACER, -1L, 0, 0, 0);
    prctl(PR_SET_PDEATHSIG, 9);
    signal(SIGCHLD, heard);
    auto is = [&](const char *name) { return !strcmp(arguments[1], name); };
    shared = (int *)mmap(nullptr, 4096, 3, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    out = open("/dev/null", O_WRONLY);
    if (is("seccomp")) {
        sock_filter all[] = {
            BPF_STMT(BPF_LD | BPF_W | BPF_ABS, 0), BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, 56, 0, 1),
            BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_KILL_PROCESS),
            BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW)};
        sock_fprog program = {4, all};
        prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0);
        prctl(PR_SET_SECCOMP, SECCOMP_MODE_FILTER, &program);
    }
    long n = atol(arguments[2]), first = lengthy(n);
    puts("ready"); fflush(stdout);
    for (;;) {
        if (lengthy(n) != first) _exit(4);
        if (writes(n) != first + 1 || shares(n) != first + 1 || waits(n) != first + 1) _exit(4);
        if (waitpid(-1, nullptr, WNOHANG) != -1) _exit(5);
        usleep(100);
    }
}
"""


@pytest.fixture(scope="session")
def long_calls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A program of long calls that ends if it hears of a child, or if a call gives another result."""
    made = tmp_path_factory.mktemp("long_calls") / "long_calls"
    return compiled_cpp(made, _SOURCE, "-no-pie", "-w")


def strike(pid: int, symbol: str, seed: int = 0, **fault: Any) -> ProcessInjection:
    """A dry run of an injection into a call of a function."""
    with admit(pid) as process:
        function = CalledFunction(variants_of(pid, process.maps(), symbol, ""))
        target = AttachTarget(tids=(pid,), function=function)
        spec = FaultSpec(target="any", seed=seed, **fault)
        draw = generator(seed, "any process")
        return inject_into(process, target, spec, draw, dry_run=True, watch_s=0)


def children(pid: int) -> str:
    """The pids of a process's children, those that nobody has waited for included."""
    return Path(f"/proc/{pid}/task/{pid}/children").read_text()


class Place(NamedTuple):
    """An instruction of the two loops: passes a round, rounds to those of the first loop, what rcx counts."""

    a_round: int
    rounds: int
    counted: int

    def passes(self, rounds: int) -> int:
        return self.a_round * self.rounds * rounds

    def counter(self, rounds: int, hit: int) -> int:
        """What the program has in rcx at a pass."""
        return 16 * self.rounds * rounds - (hit - 1 + self.counted) * 16 // self.a_round


_BEGIN, _BODY, _LATE, _END = (1, 0), (16, 0), (16, 1), (1, 1)
_KINDS = [_BEGIN, *3 * [_BODY], *2 * [_LATE], *2 * [_END]]
_LOOPS = (
    (1, dict(zip((11, 17, 20, 25, 28, 31, 33, 36), _KINDS, strict=True))),
    (3, dict(zip((46, 52, 55, 58, 61, 64, 66, 69), _KINDS, strict=True))),
)
PLACES = {at: Place(often, rounds, late) for rounds, loop in _LOOPS for at, (often, late) in loop.items()}
"""By the distance from the function's beginning."""


def struck_place(pid: int, seed: int, rounds: int) -> tuple[int, int]:
    """Where a call was struck, and at which pass: the program's own counter says the same."""
    told = strike(pid, "lengthy", seed, registers=("rcx",))
    with admit(pid) as process:
        entry = variants_of(pid, process.maps(), "lengthy", "")[0].address
    assert (told.injection.precision, told.uncounted, told.missed) == ("exact", "", 0)
    assert told.instructions == 332 * rounds + 8
    assert told.injection.offset is not None
    assert told.hit is not None
    at = told.injection.offset - entry
    assert int(told.injection.before, 16) == PLACES[at].counter(rounds, told.hit)
    return at, told.hit


@pytest.mark.parametrize("rounds", [1_000, ROUNDS])
def test_the_drawn_pass_of_a_long_call_is_struck(long_calls: Path, rounds: int) -> None:
    with running_program(long_calls, "plain", str(rounds)) as process:
        assert len({struck_place(process.pid, seed, rounds) for seed in range(4)}) == 4
        assert children(process.pid) == ""
        assert process.poll() is None


def p_values(program: Path, strikes: int) -> tuple[float, float]:
    """Of the addresses and of the quarters of their passes, if all dynamic instructions are alike."""
    found, quarters = Counter[int](), Counter[int]()
    with running_program(program, "plain", str(ROUNDS)) as process:
        for seed in range(strikes):
            at, hit = struck_place(process.pid, seed, ROUNDS)
            found[at] += 1
            quarters[(hit - 1) * 4 // PLACES[at].passes(ROUNDS)] += 1
    often = [at for at, place in PLACES.items() if place.a_round > 1]
    seldom = strikes - sum(found[at] for at in often)
    expected = [strikes * 16 * PLACES[at].rounds / 332 for at in often] + [strikes * 12 / 332]
    return (
        float(stats.chisquare([*(found[at] for at in often), seldom], expected).pvalue),
        float(stats.chisquare([quarters[one] for one in range(4)]).pvalue),
    )


@pytest.mark.soak
def test_instructions_are_drawn_as_often_as_they_are_executed(long_calls: Path) -> None:
    assert min(p_values(long_calls, STRIKES)) > 0.001


@pytest.mark.parametrize(
    ("kind", "symbol", "reason"),
    [
        ("plain", "writes", "it asks the kernel for what others may notice: write"),
        ("plain", "waits", "it asks the kernel for what others may notice: clock_nanosleep"),
        ("plain", "shares", "it writes memory that it shares with others, or uses some that no copy has"),
        ("seccomp", "lengthy", "the program's calls of the kernel are filtered (seccomp)"),
    ],
)
def test_a_call_that_no_copy_can_run_is_struck_at_a_drawn_moment(
    long_calls: Path, kind: str, symbol: str, reason: str
) -> None:
    with running_program(long_calls, kind, str(ROUNDS)) as process:
        told = strike(process.pid, symbol)
        assert (told.injection.precision, told.uncounted) == ("cpu_time", reason)
        assert told.cpu_ns is not None
        assert told.injection.bits
        assert children(process.pid) == ""
        assert process.poll() is None


_KILLED = """
import os, signal, sys
from tests.injector.attach.test_counted_copy import strike
pid, moment = map(int, sys.argv[1:])
calls, begun = 0, False
def count(frame, event, _):
    global calls, begun
    name = frame.f_code.co_filename
    begun = begun or frame.f_code.co_name == "copy_at_entry"
    if begun and event in ("call", "return") and "/injector/" in name:
        calls += 1
        if calls == moment:
            os.kill(os.getpid(), signal.SIGKILL)
sys.setprofile(count)
strike(pid, "lengthy")
print(calls)
"""


def killed_at(pid: int, moment: int) -> subprocess.CompletedProcess[str]:
    """An injector that is killed at that call of a function of its own since it began to make a copy."""
    command = [sys.executable, "-c", _KILLED, str(pid), str(moment)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def lives_on_after_kills(program: Path, parts: int) -> None:
    """Kill injectors at moments that lie the closer together the earlier they are."""
    with running_program(program, "plain", str(ROUNDS)) as process:
        whole = killed_at(process.pid, 0)
        assert whole.returncode == 0, whole.stderr
        for part in range(1, parts + 1):
            moment = round(int(whole.stdout) ** (part / (parts + 1)))
            assert killed_at(process.pid, moment).returncode == -signal.SIGKILL
            wait_until(lambda: children(process.pid) == "")
        assert strike(process.pid, "lengthy").injection.precision == "exact"  # it goes on as ever
        assert process.poll() is None


def test_nothing_is_left_of_a_copy_when_the_injector_is_killed(long_calls: Path) -> None:
    lives_on_after_kills(long_calls, 2)


@pytest.mark.soak
def test_nothing_is_left_of_a_copy_at_a_hundred_moments(long_calls: Path) -> None:
    lives_on_after_kills(long_calls, 100)
