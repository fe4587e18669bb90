"""Whether this machine lets us inject, found out by doing it on a process of our own."""

from __future__ import annotations

import ctypes
import platform
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from injector.faults.stopped_thread import registers_of
from injector.tracing.perf_events import ThreadTimer, TriggerError
from injector.tracing.ptrace import PtraceError
from injector.tracing.tracees import StopError, TraceeGroup

_YAMA = Path("/proc/sys/kernel/yama/ptrace_scope")
_CAP_SYS_PTRACE = 19


@dataclass(frozen=True, slots=True)
class Capability:
    """One check: what was checked, whether it is in order, and what to do if it is not."""

    name: str
    ok: bool
    remedy: str


def check() -> list[Capability]:
    """Every check, in the order in which an injection needs them; takes some 20 ms."""
    architecture = _architecture()
    if not architecture.ok:
        return [architecture]
    child = subprocess.Popen(
        [sys.executable, "-I", "-S", "-c", "import sys; sys.stdin.read()"], stdin=subprocess.PIPE
    )
    try:
        return [architecture, _yama(), *_tracing(child.pid)]
    finally:
        child.kill()
        child.communicate()


def _architecture() -> Capability:
    machine = platform.machine()
    supported = (sys.platform, machine, ctypes.sizeof(ctypes.c_void_p)) == ("linux", "x86_64", 8)
    return Capability(
        f"{sys.platform} on {machine}", supported, "injection needs Linux on x86-64 and a 64-bit Python"
    )


def _yama() -> Capability:
    """Scope 0 and 1 are fine: nodes name the injector as their tracer."""
    try:
        scope = int(_YAMA.read_text())
    except OSError:
        return Capability("Yama does not restrict ptrace", ok=True, remedy="")
    return Capability(
        f"Yama ptrace_scope is {scope}",
        scope <= 1 or (scope == 2 and _has_capability(_CAP_SYS_PTRACE)),
        f"set {_YAMA} to 1" + ("" if scope == 2 else ", which needs a reboot"),
    )


def _has_capability(number: int) -> bool:
    status = Path("/proc/self/status").read_text()
    return bool(int(status.partition("CapEff:")[2].split(maxsplit=1)[0], 16) >> number & 1)


def _tracing(pid: int) -> list[Capability]:
    ptrace, perf = "ptrace: seize, stop, read registers", "perf: trap by a thread's own time"
    with TraceeGroup() as tracees:
        try:
            tracees.seize([pid])
            tracees.stop_all()
            registers_of(tracees.threads[pid])
        except (PtraceError, StopError) as error:
            return [Capability(ptrace, ok=False, remedy=str(error))]
        try:
            with ThreadTimer(tracees.threads[pid], cpu_ns=10**9):
                pass
        except TriggerError as error:
            return [Capability(ptrace, ok=True, remedy=""), Capability(perf, ok=False, remedy=str(error))]
    return [Capability(ptrace, ok=True, remedy=""), Capability(perf, ok=True, remedy="")]
