"""A program that makes a call like a node's: a gate, probes, and marks where the call begins and ends.

The call is a loop in machine code: ``passes`` times ``add rax,rcx``, then ``ret``.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path

from injector.flight.approach import KernelCall
from injector.flight.injection import inject as inject_into
from injector.flight.probe import ProbeRun, sent_ahead
from services.bus.announce import Announcement, boot_id, start_ticks
from services.models.faults.specification import FaultSpec, Site, Trigger
from services.models.outcome import InjectionRecord
from services.runtime.rng import generator

LOOP = "add rax,rcx"

_CALLER = """
import ctypes, mmap, os, signal, sys
sys.path.insert(0, sys.argv[1])
from services.system.lifeline import die_with_parent
libc = ctypes.CDLL(None)
libc.prctl(0x59616D61, ctypes.c_ulong(-1), 0, 0, 0)  # anybody may trace us
libc.prctl(1, 9)  # die with the test
page = mmap.mmap(-1, 4096, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
#       xor eax,eax; mov ecx,edi; add rax,rcx; dec ecx; jnz -7; ret
code = bytes.fromhex("31c0 89f9 4801c8 ffc9 75f9 c3")
page[:len(code)] = code
address = ctypes.addressof(ctypes.c_char.from_buffer(page))
assert libc.mprotect(ctypes.c_void_p(address), 4096, mmap.PROT_READ | mmap.PROT_EXEC) == 0
call = ctypes.PYFUNCTYPE(ctypes.c_uint64, ctypes.c_uint32)(address)
call(1)
print(address + 4, flush=True)
while (line := sys.stdin.readline()) != "pass\\n":
    if line == "probe\\n":
        probe = os.fork()
        if not probe:
            die_with_parent()
            break
        os.waitpid(probe, 0)
    print("gate", flush=True)
signal.raise_signal(signal.SIGURG)
result = call(int(sys.argv[2]))
signal.raise_signal(signal.SIGURG)
if line != "probe\\n":
    print(result, flush=True)
"""


class Caller:
    """The program while it waits at its gate; ``loop`` is the address of the instruction in the loop."""

    def __init__(self, passes: int) -> None:
        root = str(Path(__file__).parents[2])
        self.process = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", _CALLER, root, str(passes)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            process_group=0,
        )
        self.pid = self.process.pid
        self.loop = int(self.line())
        self.right = passes * (passes + 1) // 2

    def line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline()

    def tell(self, word: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(word + "\n")
        self.process.stdin.flush()

    def announcement(self) -> Announcement:
        return Announcement("node", self.pid, self.pid, start_ticks(self.pid), boot_id())

    @contextmanager
    def ahead(self) -> Iterator[ProbeRun]:
        """A probe; the program is at its gate again afterwards."""
        with sent_ahead(self.announcement(), lambda: self.tell("probe")) as probe:
            yield probe
        assert self.line() == "gate\n"

    def trace(self, most: int = 10**6) -> list[int]:
        """Where the instructions of the call lie that a probe executes in single steps, to its end."""
        with self.ahead() as probe:
            addresses = probe.tracees.trace(probe.thread, most)
            assert probe.thread.report is not None
            assert probe.thread.report.kind == "gate"
        return addresses[:-1]  # at the last one the mark comes first

    @property
    def probes(self) -> Callable[[], AbstractContextManager[ProbeRun]]:
        return self.ahead

    def inject(self, fault: FaultSpec, seed: int = 0) -> InjectionRecord:
        call = KernelCall(self.announcement(), 0, armed=lambda: self.tell("pass"), marked=True)
        return inject_into(call, [], fault, generator(seed, "test"))

    def result(self) -> int:
        """What the call returned; the program ends."""
        output, _ = self.process.communicate(timeout=600)
        assert self.process.returncode == 0
        return int(output)


@contextmanager
def caller(passes: int) -> Iterator[Caller]:
    """The program, gone afterwards."""
    one = Caller(passes)
    try:
        yield one
    finally:
        with suppress(ProcessLookupError):
            os.killpg(one.pid, signal.SIGKILL)  # its probes too
        one.process.communicate()


def registers_in_the_loop(passes: int, passing: int) -> dict[str, int]:
    """What the loop's registers hold before its addition is executed for the ``passing``-th time."""
    left = passes - passing + 1
    return {"rcx": left, "rax": sum(range(left + 1, passes + 1))}


def aimed_at_a_source(site: Site) -> FaultSpec:
    """A fault in a general register that the instruction at a site reads."""
    trigger = Trigger(invocation=0, site=site)
    return FaultSpec(target="kernel", operand="source", register_class="gpr", trigger=trigger)
