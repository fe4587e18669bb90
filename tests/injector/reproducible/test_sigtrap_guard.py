"""Whoever is struck lives on when its injector is killed, at whatever moment."""

import ctypes
import mmap
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from injector.reproducible.sigtrap_guard import guard_against_traps
from injector.tracing.process import tracer_of
from tests.injector.programs import clock_ns

pytestmark = pytest.mark.usefixtures("may_inject")

STEPPER = """
import sys
from injector.tracing.tracees import TraceeGroup
with TraceeGroup() as tracees:
    tracees.seize([int(sys.argv[1])])
    while True:
        tracees.stop_all()
        for _ in range(50):
            tracees.step(tracees.threads[int(sys.argv[1])])
        tracees.resume_all()
"""


def test_a_node_outlives_injectors_that_are_killed_while_they_step() -> None:
    node = os.fork()
    if not node:
        guard_against_traps()
        while True:
            sum(range(100))
    try:
        for moment in range(12):
            injector = subprocess.Popen(
                [sys.executable, "-c", STEPPER, str(node)], cwd=Path(__file__).parents[3]
            )
            while not tracer_of(node):
                assert injector.poll() is None
            time.sleep(0.0013 * moment)
            injector.kill()
            injector.wait()
            assert tracer_of(node) == 0
            begin = clock_ns(node)
            while clock_ns(node) < begin + 1_000_000:
                assert os.waitpid(node, os.WNOHANG) == (0, 0)
    finally:
        os.kill(node, signal.SIGKILL)


def test_a_breakpoint_instruction_kills_as_ever() -> None:
    """A fault may lead to one; to survive it would be another outcome."""
    node = os.fork()
    if not node:
        guard_against_traps()
        page = mmap.mmap(-1, mmap.PAGESIZE, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
        page[:2] = b"\xcc\xc3"  # int3; ret
        ctypes.CFUNCTYPE(None)(ctypes.addressof(ctypes.c_char.from_buffer(page)))()
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(node, 0)[1]) == -signal.SIGTRAP
