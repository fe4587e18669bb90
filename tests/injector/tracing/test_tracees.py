"""Freezing stops every thread, loses nothing, and always lets go."""

import ctypes
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from injector.faults.stopped_thread import registers_of
from injector.tracing import ptrace, tracees
from injector.tracing.process import threads, tracer_of
from injector.tracing.tracees import TraceeGroup
from injector.tracing.waiting import wait_until
from tests.injector.programs import PATIENCE_S, assemble, clock_ns, running, state

pytestmark = pytest.mark.usefixtures("may_inject")

SIGNALLED = """
import os, signal, sys
count = 0
def handle(number, frame):
    global count
    count += 1
    os.write(1, b"%d\\n" % count)
signal.signal(signal.SIGUSR1, handle)
print("ready", flush=True)
sys.stdin.read()
"""

BUSY = """
import signal
count = 0
def handle(number, frame):
    global count
    count += 1
signal.signal(signal.SIGUSR1, handle)
signal.signal(signal.SIGUSR2, handle)
print("ready", flush=True)
while count < 2: pass
print(count)
"""

PARENT = """
import os, threading
pid = os.fork()
if not pid:
    for _ in range(4): threading.Thread(target=threading.Event().wait, daemon=True).start()
    print("ready", os.getpid(), sep="\\n", flush=True)
    while True: pass
print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
"""

TRAPPED = """
import ctypes, os, signal, struct, sys
signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTRAP})
trap = ctypes.create_string_buffer(struct.pack("iii", signal.SIGTRAP, 0, 6), 128)
rt_tgsigqueueinfo = 297
assert ctypes.CDLL(None).syscall(rt_tgsigqueueinfo, os.getpid(), os.getpid(), signal.SIGTRAP, trap) == 0
print("ready", flush=True)
print(sys.stdin.read())
"""

UNSTOPPABLE = """
import ctypes, os, time
if not ctypes.CDLL(None).vfork():  # whoever has forked so is not to be disturbed until the child is gone
    os.write(1, b"ready\\n")
    time.sleep(600)
"""

BREEDER = """
import sys, threading
print("ready", flush=True)
while True:
    several = [threading.Thread(target=sum, args=(range(1000),)) for _ in range(4)]
    for one in several: one.start()
    for one in several: one.join()
"""


def python(program: str) -> subprocess.Popen[bytes]:
    process = subprocess.Popen(
        [sys.executable, "-I", "-S", "-c", program],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        process_group=0,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"ready\n"
    return process


def test_every_thread_of_every_process_stands_and_goes_on() -> None:
    with (
        running(assemble(), threads=5) as one,
        running(assemble(), threads=2) as two,
        TraceeGroup() as tracees,
    ):
        one.start()
        two.start()
        everybody = threads(one.pid) + threads(two.pid)
        tracees.seize([one.pid, two.pid])
        one.wait_for_progress()  # seized is not stopped
        for _ in range(20):
            tracees.stop_all()
            assert [state(tid) for tid in everybody] == ["t"] * 9
            assert tracees.threads_stopped == 9
            before = one.rounds, two.rounds
            assert (one.rounds, two.rounds) == before
            tracees.resume_all()
            assert tracees.pause_us > 0
            one.wait_for_progress(1)
            two.wait_for_progress(1)
        tracees.detach_all()
        assert [tracer_of(tid) for tid in everybody] == [0] * 9
        one.wait_for_progress()
        two.wait_for_progress()


def test_an_exception_while_all_stand_lets_go_of_all() -> None:
    def fail(pid: int) -> None:
        with TraceeGroup() as tracees:
            tracees.seize([pid])
            tracees.stop_all()
            raise RuntimeError("on the way")

    with running(assemble(), threads=3) as target:
        target.start()
        with pytest.raises(RuntimeError, match="on the way"):
            fail(target.pid)
        assert {tracer_of(tid) for tid in threads(target.pid)} == {0}
        target.wait_for_progress()


def test_threads_that_come_and_go_are_caught() -> None:
    breeder = python(BREEDER)
    try:
        for _ in range(20):
            with TraceeGroup() as tracees:
                tracees.seize([breeder.pid])
                for _ in range(5):
                    tracees.stop_all()
                    alive = [tid for tid in threads(breeder.pid) if state(tid) not in "ZX"]
                    assert {state(tid) for tid in alive} == {"t"}
                    tracees.resume_all()
                    tracees.service()
        assert {tracer_of(tid) for tid in threads(breeder.pid)} == {0}
        assert breeder.poll() is None
    finally:
        breeder.kill()
        breeder.communicate()


def test_a_thread_that_was_missed_is_caught_when_all_are_stopped() -> None:
    with running(assemble(), threads=2) as target, TraceeGroup() as tracees:
        target.start()
        tracees.seize([target.pid])
        tracees.stop_all()
        missed = threads(target.pid)[1]
        ptrace.detach(missed)
        del tracees.threads[missed]
        tracees.resume_all()
        tracees.stop_all()
        assert {state(tid) for tid in threads(target.pid)} == {"t"}
        assert tracees.threads_stopped == 3


def test_a_thread_that_cannot_be_stopped_is_not_waited_for_without_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tracees, "STOP_LIMIT_S", 0.5)
    stuck = python(UNSTOPPABLE)
    try:
        with running(assemble(), threads=2) as other:
            other.start()
            with pytest.raises(tracees.StopError, match=rf"thread {stuck.pid} of process {stuck.pid}$"):
                stop(other.pid, stuck.pid)
            assert {tracer_of(tid) for tid in threads(other.pid)} == {0}
            other.wait_for_progress()
    finally:
        os.killpg(stuck.pid, signal.SIGKILL)
        stuck.communicate()


def stop(*pids: int) -> None:
    with TraceeGroup() as tracees:
        tracees.seize(pids)
        tracees.stop_all()


def test_a_timers_trap_that_is_queued_when_its_thread_is_let_go_does_not_kill() -> None:
    """The trap is made by the program itself, and held back until it stands."""
    with TraceeGroup() as tracees:
        process = python(TRAPPED)
        tracees.seize([process.pid])
        tracees.stop_all()
        tracees.threads[process.pid].timed = True
        nothing_blocked = ctypes.c_uint64(0)
        libc = ctypes.CDLL(None)
        setsigmask = 0x420B
        assert libc.ptrace(setsigmask, process.pid, ctypes.c_void_p(8), ctypes.byref(nothing_blocked)) == 0
        assert ptrace.timer_trap_pending(process.pid)
    assert process.communicate(b"42", timeout=PATIENCE_S)[0] == b"42\n"
    assert process.returncode == 0


def test_signals_sent_while_standing_arrive() -> None:
    process = python(SIGNALLED)
    assert process.stdout is not None
    for count in range(1, 6):
        with TraceeGroup() as tracees:
            tracees.seize([process.pid])
            tracees.stop_all()
            os.kill(process.pid, signal.SIGUSR1)
        assert process.stdout.readline() == f"{count}\n".encode()
    process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0


def test_signals_while_stepping_wait_and_arrive() -> None:
    process = python(BUSY)
    with TraceeGroup() as tracees:
        tracees.seize([process.pid])
        process_clock = clock_ns(process.pid)
        assert wait_until(lambda: clock_ns(process.pid) > process_clock + 10**6 or None, PATIENCE_S)
        tracees.stop_all()
        thread = tracees.threads[process.pid]
        for number in (signal.SIGUSR1, signal.SIGUSR2):
            os.kill(process.pid, number)
            place = registers_of(thread).program_counter
            assert tracees.step(thread) == "stepped"
            assert abs(registers_of(thread).program_counter - place) < 2**20  # in no handler
    output, _ = process.communicate(timeout=PATIENCE_S)
    assert output == b"2\n"
    assert process.returncode == 0


def test_a_stopped_process_stays_stopped_until_continued() -> None:
    with running(assemble(), threads=2) as target:
        target.start()
        os.kill(target.pid, signal.SIGSTOP)
        os.waitid(os.P_PID, target.pid, os.WSTOPPED)
        with TraceeGroup() as tracees:
            tracees.seize([target.pid])
            tracees.stop_all()
            before = target.rounds
            for _ in range(100):
                tracees.resume_all()  # does not end it
                tracees.stop_all()
            assert target.rounds == before
        # Each goes back into the stop by itself.
        deadline = time.monotonic() + PATIENCE_S
        while {state(tid) for tid in threads(target.pid)} != {"T"}:
            assert time.monotonic() < deadline
        os.kill(target.pid, signal.SIGCONT)
        target.wait_for_progress()


def test_the_parent_of_a_process_killed_while_standing_hears_of_it() -> None:
    with running(assemble()) as other, TraceeGroup() as tracees:
        other.start()
        parent = python(PARENT)
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        tracees.seize([pid, other.pid])
        tracees.stop_all()
        os.kill(pid, signal.SIGKILL)
        tracees.detach_all()
        assert parent.communicate(timeout=PATIENCE_S)[0] == b"-9\n"
        other.wait_for_progress()


def test_the_parent_of_a_process_killed_while_running_hears_of_it() -> None:
    parent = python(PARENT)
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    with TraceeGroup() as tracees:
        tracees.seize([pid])
        os.kill(pid, signal.SIGKILL)
        deadline = time.monotonic() + PATIENCE_S
        while tracees.threads and time.monotonic() < deadline:
            tracees.service()
        assert not tracees.threads
        assert parent.communicate(timeout=PATIENCE_S)[0] == b"-9\n"


def test_one_step_is_one_instruction_and_the_others_stand() -> None:
    with running(assemble(), threads=2) as target:
        target.start()
        with TraceeGroup() as tracees:
            tracees.seize([target.pid])
            tracees.stop_all()
            thread, before = tracees.threads[target.pid], target.rounds
            places = []
            for _ in range(30):  # a round of three instructions: cmp, je, add
                places.append(registers_of(thread).program_counter)
                assert tracees.step(thread) == "stepped"
            assert places[3:] == places[:-3]
            assert len(set(places)) == 3
            assert target.rounds - before == 10
            assert {state(tid) for tid in threads(target.pid)} == {"t"}
        target.wait_for_progress()  # let go in single steps, it goes on without them


def test_whoever_is_traced_already_is_refused() -> None:
    seized, done = threading.Event(), threading.Event()

    def debugger(pid: int) -> None:
        with TraceeGroup() as tracees:
            tracees.seize([pid])
            seized.set()
            done.wait()

    with running(assemble()) as target:
        other = threading.Thread(target=debugger, args=(target.pid,))
        other.start()
        seized.wait()
        with TraceeGroup() as tracees, pytest.raises(ptrace.NotPermittedError, match="debugger"):
            tracees.seize([target.pid])
        done.set()
        other.join()
