"""A call that reads clocks takes the same way whenever it does."""

import time
from pathlib import Path

import pytest

from tests.injector.forked_calls import standing

pytestmark = pytest.mark.usefixtures("may_inject")

READS = """
#define _GNU_SOURCE
#include <sched.h>
#include <sys/time.h>
#include <time.h>
double kernel(void) {
    struct timespec now, fine;
    struct timeval day;
    unsigned ordered = 0;
    for (int i = 0; i < 20; i++) {
        clock_gettime(CLOCK_MONOTONIC, &now);
        clock_getres(CLOCK_MONOTONIC, &fine);
        gettimeofday(&day, 0);
        long late = time(0) - day.tv_sec;
        ordered += now.tv_sec > 0 && fine.tv_nsec == 1 && late >= -1 && late <= 1 && sched_getcpu() >= 0;
    }
    return ordered;
}
"""


def test_a_call_that_reads_clocks_executes_the_same_instructions_however_long_it_takes(
    tmp_path: Path,
) -> None:
    with standing(tmp_path, READS) as one:
        trace = one.trace()
        assert one.result(one.forks.copy(one.root)) == 20
        for _ in range(20):  # each of some 3,000 steps, so that the clocks are set several times in each
            assert one.trace() == trace
        copy = one.forks.copy(one.root)
        found: list[int] = []
        while copy.report is None or copy.report.kind != "gate":
            found += one.tracees.trace(copy, 41)
            time.sleep(0.002)
        one.forks.end(copy)
        assert found == trace
