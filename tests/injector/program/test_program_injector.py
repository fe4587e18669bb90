"""What comes of runs with a fault: each outcome, replays, and who else may kill a run."""

import os
import signal
import struct
import threading
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chisquare

from injector.kernel_study.results import StudyRun
from injector.program.comparison import UnsuitableProgramError
from injector.program.profile import ScopeError
from injector.tracing.ptrace import PtraceError
from services.models.faults.specification import FaultSpec
from tests.conftest import descendants
from tests.injector.program.launched import (
    COUNTS,
    LIMIT_S,
    compiled,
    injector_of,
    offset_of,
    runs_of,
    spec_of,
)

CHECKS = """
#include <stdio.h>
#include <stdlib.h>
unsigned long table[64];
int main(void) {
    volatile unsigned long sum = 0, again = 0, unused = 0;
    for (unsigned long at = 0; at < 64; at++) table[at] = at;
    for (unsigned long at = 0; at < 2000; at++) {
        sum += table[at % 64]; again += table[at % 64]; unused += at;
    }
    if (sum != again) exit(3);
    printf("%lu\\n", sum);
}
"""
FAULT = FaultSpec(target="program", scope="thread")


def test_outcomes(tmp_path: Path) -> None:
    spec = spec_of([compiled(tmp_path, CHECKS, "checks")], module="checks", detected=(3,))
    with injector_of(spec) as injector:
        _, points = injector.draw(FAULT, 1, range(120))
        runs = [run for _, run in injector.run(points, FAULT, 1)]
        again = [run for _, run in injector.run(points[:20], FAULT, 1)]
    found = Counter(run.result for run in runs)
    assert {"benign", "sdc", "crash", "detected"} <= found.keys()
    assert found["not_injected"] == 0
    assert {run.cause for run in runs if run.result == "crash"} <= {"SIGSEGV", "SIGBUS", "SIGILL", "SIGFPE"}
    assert {run.cause for run in runs if run.result == "detected"} == {"exit status 3"}
    assert all(run.injection.before != run.injection.after == run.injection.read_back for run in runs)
    assert again == runs[:20]


def test_no_fault_changes_nothing(tmp_path: Path) -> None:
    fault = FAULT.model_copy(update={"model": "none"})
    with injector_of(spec_of([compiled(tmp_path, CHECKS, "checks")])) as injector:
        _, points = injector.draw(fault, 2, range(30))
        assert {run.result for _, run in injector.run(points, fault, 2)} == {"benign"}


TICKS = """
#include <signal.h>
#include <sys/time.h>
static void tick(int number) {}
__attribute__((constructor)) static void begin(void) {
    struct itimerval each = {{0, 5000}, {0, 5000}};
    signal(SIGALRM, tick);
    setitimer(ITIMER_REAL, &each, 0);
}
"""
"""A signal every 5 ms, of which the tracer hears: Go's scheduler sends such ones."""


@pytest.mark.parametrize("more", ["", TICKS])
def test_an_endless_run_hangs(tmp_path: Path, more: str) -> None:
    program = compiled(tmp_path, COUNTS + more, "counts")
    spec = spec_of([program, "1000"], module="counts", address=offset_of(program, "tight"))
    # The highest bit of what counts down.
    fault = FaultSpec(
        target="counts", scope="thread", operand="source", register_class="gpr", bit_numbers=(62,)
    )
    with injector_of(spec) as injector:
        _, points = injector.draw(fault, 1, range(1))
        ((_, run),) = injector.run(points, fault, 1)
    assert (run.result, list(run.injection.bits)) == ("hang", [62])


def test_each_eligible_instruction_is_drawn_as_often_as_it_is_executed(tmp_path: Path) -> None:
    fault = FaultSpec(target="counts", scope="thread", register_class="gpr", operand="destination", bits=2)
    program = compiled(tmp_path, COUNTS, "counts")
    with injector_of(spec_of([program, "500"], module="counts")) as injector:
        _, points = injector.draw(fault, 7, range(2000))
        eligible = injector.counted().eligible(fault)
    drawn = Counter(point.address for point in points)
    assert drawn.keys() <= set(eligible.addresses.tolist())
    expected = 2000 * eligible.passes / eligible.passes.sum()
    often = expected >= 5
    observed = np.array([drawn[int(one)] for one in eligible.addresses])
    rare = expected[~often].sum()
    ours, theirs = np.append(observed[often], observed[~often].sum()), np.append(expected[often], rare)
    assert chisquare(ours, theirs).pvalue > 0.01
    assert max(point.hit for point in points) <= eligible.passes.max()


def test_only_the_code_that_is_asked_for_is_struck(tmp_path: Path) -> None:
    program = compiled(tmp_path, CHECKS, "checks")
    for narrowed in ({"symbol": "main"}, {"module": "checks", "symbol": "main"}):
        with injector_of(spec_of([program], **narrowed)) as injector:
            _, points = injector.draw(FAULT, 1, range(10))
            runs = [run for _, run in injector.run(points, FAULT, 1)]
        assert {run.injection.symbol for run in runs} == {"main"}
    for absent in ({"symbol": "nothing_of_this_name"}, {"module": "libnothing"}):
        with (
            injector_of(spec_of([program], **absent)) as injector,
            pytest.raises(ScopeError, match="nothing"),
        ):
            injector.draw(FAULT, 1, range(1))


@pytest.mark.parametrize(
    ("command", "more", "problem"),
    [
        (["date", "+%N"], {}, "not the same in each run without a fault .stdout."),
        (["sh", "-c", "kill -SEGV $$"], {}, "SIGSEGV ends it without a fault"),
        (["sh", "-c", "exit 3"], {"status": 3, "detected": (3,)}, "ends so without a fault, too"),
        (
            ["sh", "-c", "echo why >&2; exit 3"],
            {},
            r"exit status 3 without a fault .why.; if that is right: --status 3",
        ),
        (["sh", "-c", "echo x > /new"], {}, "--input or --compare FILE gives it a folder in which it can"),
        (["true"], {"compare": ("result",)}, "writes no such file"),
        (["sleep", "1000"], {}, "did not end within"),
    ],
)
def test_what_cannot_be_judged_is_refused(command: list[str], more: dict[str, object], problem: str) -> None:
    with (
        runs_of(spec_of(command, **more)) as runs,
        pytest.raises(UnsuitableProgramError, match=problem),
    ):
        runs.golden(1.0)


def test_files_are_compared_in_a_folder_of_the_run(tmp_path: Path) -> None:
    (tmp_path / "data").write_bytes(b"data" * 100)
    spec = spec_of(["gzip", "-n", "data"], folder=str(tmp_path), inputs=("data",), compare=("data.gz",))
    with injector_of(spec) as injector:
        _, points = injector.draw(FAULT, 1, range(40))
        causes = {run.cause for _, run in injector.run(points, FAULT, 1) if run.result == "sdc"}
    assert any("data.gz" in one for one in causes)
    assert [one.name for one in tmp_path.iterdir()] == ["data"]


def test_a_run_that_another_process_kills_is_made_again(tmp_path: Path) -> None:
    source = "int main(void) { volatile long at = 0; while (at < 200000000) at++; }"
    spec = spec_of([compiled(tmp_path, source, "long")], module="long")
    fault = FAULT.model_copy(update={"model": "none"})
    with injector_of(spec) as injector:
        _, points = injector.draw(fault, 1, range(2))
        killed: list[int] = []

        def kill_one() -> None:
            while not killed:
                time.sleep(0.05)
                for pid in descendants(os.getpid()):
                    with suppress(OSError):
                        if Path(f"/proc/{pid}/comm").read_text() == "long\n":
                            os.kill(pid, signal.SIGTERM)
                            killed.append(pid)

        killer = threading.Thread(target=kill_one)
        killer.start()
        results = [run.result for _, run in injector.run(points, fault, 1)]
        killer.join()
    assert killed
    assert results == ["benign", "benign"]


NUMBERS = """
#include <math.h>
#include <stdio.h>
double sum;
int main(void) {
    for (int at = 1; at < 3000; at++) sum += sqrt(at) / at;
    printf("sum %.12g\\n", sum);
}
"""


def test_a_tolerance_and_a_comparator_say_what_counts_as_the_same(tmp_path: Path) -> None:
    program = compiled(tmp_path, NUMBERS, "numbers", "-lm")
    fault = FAULT.model_copy(update={"field": "mantissa"})

    def outcomes(**more: object) -> list[StudyRun]:
        with injector_of(spec_of([program], module="numbers", **more)) as injector:
            _, points = injector.draw(fault, 1, range(20))
            return [run for _, run in injector.run(points, fault, 1)]

    exact, loose = outcomes(), outcomes(tolerance=0.01)
    assert {"sdc"} <= {run.result for run in exact} <= {"sdc", "benign"}
    changed = [run for run, was in zip(loose, exact, strict=True) if was.result == "sdc"]
    assert all(run.deviation is not None for run in changed)
    assert all((run.result == "benign") == run.within_tolerance for run in changed)
    assert all((run.deviation or 0.0) <= 0.01 for run in changed if run.within_tolerance)
    assert any(run.within_tolerance for run in changed)
    (tmp_path / "always").write_text("#!/bin/sh\nexit 0\n")
    (tmp_path / "always").chmod(0o755)
    assert {run.result for run in outcomes(comparator=(str(tmp_path / "always"),))} == {"benign"}


def test_what_never_repeats_is_struck_with_a_comparator(tmp_path: Path) -> None:
    (tmp_path / "alike").write_text("#!/bin/sh\ngrep -q '^[0-9]*$' $2/stdout\n")
    (tmp_path / "alike").chmod(0o755)
    spec = spec_of(["date", "+%N"], comparator=(str(tmp_path / "alike"),))
    with injector_of(spec) as injector:
        _, points = injector.draw(FAULT, 1, range(15))
        found = {run.result for _, run in injector.run(points, FAULT, 1)}
    assert "benign" in found


ALONE = """
#include <linux/seccomp.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <unistd.h>
volatile unsigned long sum;
int main(void) {
    prctl(PR_SET_SECCOMP, SECCOMP_MODE_STRICT);
    for (int at = 0; at < 5000; at++) sum += at;
    write(1, sum == 12497500 ? "right\\n" : "wrong\\n", 6);
    syscall(SYS_exit, 0);
}
"""


def test_a_program_that_may_call_the_kernel_no_more_is_struck(tmp_path: Path) -> None:
    with injector_of(spec_of([compiled(tmp_path, ALONE, "alone")], module="alone")) as injector:
        _, points = injector.draw(FAULT, 1, range(30))
        runs = [run for _, run in injector.run(points, FAULT, 1)]
    assert {run.injection.status for run in runs} == {"injected"}
    assert {"benign", "sdc"} <= {run.result for run in runs}
    assert any(run.point is not None and run.point.counted_at for run in runs)


def test_a_32_bit_program_is_refused(tmp_path: Path) -> None:
    # An ELF file for i386 whose first instructions are exit(0): int 0x80 with eax 1 and ebx 0.
    head = b"\x7fELF\x01\x01\x01".ljust(16, b"\0")
    head += struct.pack("<HHIIIIIHHHHHH", 2, 3, 1, 0x8048054, 52, 0, 0, 52, 32, 1, 0, 0, 0)
    code = b"\x31\xdb\xb8\x01\x00\x00\x00\xcd\x80"
    segment = struct.pack("<IIIIIIII", 1, 0, 0x8048000, 0x8048000, 84 + len(code), 84 + len(code), 5, 0x1000)
    program = tmp_path / "old"
    program.write_bytes(head + segment + code)
    program.chmod(0o755)
    with runs_of(spec_of([program])) as runs, pytest.raises(PtraceError, match="32-bit"):
        runs.golden(LIMIT_S)
