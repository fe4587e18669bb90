"""A process that somebody has stopped is struck where it stands, and stays stopped until it is let go on."""

import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from injector.tracing.process import threads, tracer_of
from tests.conftest import PATIENCE_S, wait_until
from tests.dashboard.command import refusal, zenfi
from tests.injector.cpp_program import running_program
from tests.injector.program.launched import compiled
from tests.injector.programs import clock_ns, state

pytestmark = pytest.mark.usefixtures("may_inject")

_SPINNING = """
#include <stdio.h>
#include <sys/prctl.h>
#include <pthread.h>
#include <unistd.h>
void *waits(void *nothing) { for (;;) pause(); }
int main(void) {
    long value = 0;
    pthread_t other;
    prctl(PR_SET_PTRACER, -1L, 0, 0, 0);
    prctl(PR_SET_PDEATHSIG, 9);
    pthread_create(&other, 0, waits, 0);
    puts("ready");
    fflush(stdout);
    __asm__ volatile("1: test %0, %0\\n jz 1b" : "+b"(value));
    printf("%lx\\n", value);
    return 3;
}
"""


@pytest.fixture(scope="session")
def spinning(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A program that spins until its register rbx is not 0, which it prints then."""
    return compiled(tmp_path_factory.mktemp("spinning"), _SPINNING, "spinning", "-pthread")


@pytest.fixture
def stopped(spinning: Path) -> Iterator["subprocess.Popen[bytes]"]:
    """The program, stopped by a signal while it spins."""
    with running_program(spinning) as process:
        wait_until(lambda: clock_ns(process.pid) > 20_000_000)
        process.send_signal(signal.SIGSTOP)
        wait_until(lambda: state(process.pid) == "T")
        yield process


def assert_stands(process: "subprocess.Popen[bytes]") -> None:
    """All threads stop again, untraced: one that is detached wakes for a moment first."""
    wait_until(lambda: all((state(tid), tracer_of(tid)) == ("T", 0) for tid in threads(process.pid)))


@pytest.mark.parametrize(
    ("fault", "value"),
    [
        ("operand=source,bit_numbers=5", "20"),
        ("operand=source,model=stuck_at,stuck_value=1,stuck_instructions=2,bit_numbers=7", "80"),
    ],
)
def test_the_fault_is_in_it_when_it_goes_on(
    stopped: "subprocess.Popen[bytes]", fault: str, value: str
) -> None:
    answer = zenfi("inject", "--pid", stopped.pid, "--fault", f"register_class=gpr,{fault}")
    assert (answer.returncode, answer.stderr) == (0, "")
    assert "it is stopped, as it was before" in answer.stdout
    assert_stands(stopped)
    stopped.send_signal(signal.SIGCONT)
    out, _ = stopped.communicate(timeout=PATIENCE_S)
    assert (out.decode().strip(), stopped.returncode) == (value, 3)


def test_a_step_of_it_leaves_it_stopped(stopped: "subprocess.Popen[bytes]") -> None:
    options = ("--fault", "operand=destination,register_class=flags", "--dry-run")
    answer = zenfi("inject", "--pid", stopped.pid, *options)
    assert (answer.returncode, answer.stderr) == (0, "")
    assert_stands(stopped)
    stopped.send_signal(signal.SIGCONT)
    begin = clock_ns(stopped.pid)
    wait_until(lambda: clock_ns(stopped.pid) > begin + 10_000_000)


def test_what_needs_it_to_run_is_one_line(stopped: "subprocess.Popen[bytes]") -> None:
    for option, given in (("symbol", "main"), ("module", "libc"), ("cpu-s", "0.1"), ("after-s", "0.1")):
        said = refusal("inject", "--pid", stopped.pid, f"--{option}", given)
        assert said.startswith(
            f"process {stopped.pid} (spinning) is stopped, and {option.replace('-', '_')} "
        )
        assert f"kill -CONT {stopped.pid}" in said
    assert_stands(stopped)


def test_in_a_system_call_nothing_is_struck(stopped: "subprocess.Popen[bytes]") -> None:
    waiting = threads(stopped.pid)[1]
    answer = zenfi("inject", "--pid", stopped.pid, "--thread", waiting)
    assert answer.returncode == 1
    assert f"thread {waiting} waits in a system call, where nothing is struck" in answer.stdout
    assert_stands(stopped)


def test_one_that_a_debugger_has_stopped_is_one_line(spinning: Path) -> None:
    debugger = shutil.which("gdb")
    if debugger is None:
        pytest.skip("no debugger (gdb) on this machine")
    with running_program(spinning) as process:
        options = ["-q", "-nx", "-ex", f"attach {process.pid}"]
        with subprocess.Popen(
            [debugger, *options], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        ) as tracing:
            try:
                wait_until(lambda: state(process.pid) == "t")
                said = refusal("inject", "--pid", process.pid)
                assert said.startswith(f"process {process.pid} is traced by process {tracing.pid} (gdb)")
            finally:
                tracing.kill()
