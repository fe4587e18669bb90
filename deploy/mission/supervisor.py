"""The processes of one mission: started, watched, counted, ended.

The supervisor knows processes and their stats, not messages: what a death means for the flight is
decided in ``deploy/mission/restarts.py``.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from deploy.config.processes import ProcessDeclaration
from deploy.errors import DisturbedFlightError, InfrastructureError
from deploy.mission.fork_protocol import EXIT_BUG, EXIT_NONSENSE, EXIT_REAPER
from deploy.mission.fork_server import Exited, ForkServer
from injector.tracing.process import tracer_of
from services.bus.session import BusAddress
from services.models.faults.specification import Trigger
from services.models.outcome import KernelUse, NodeReport, NodeResult
from services.models.pilots import numbered
from services.runtime.setup import NodeSetup
from services.system.process_stat import is_stopped, main_thread_stat, process_stat
from services.system.shared_stats import COMPUTING, MESSAGING, WAITING, SharedStats
from services.system.signal_names import signal_name

LEFT_S = 300.0
"""Longest wait for the processes of a mission that is over, killed ones included."""


@dataclass
class SupervisedNode:
    """One process of the mission over all its restarts."""

    process: ProcessDeclaration
    stats: SharedStats
    log: Path
    kernels: list[str]
    guards: tuple[str, ...]
    pid: int = 0
    pidfd: int = -1
    life: int = -1
    alive: bool = False
    crashes: int = 0
    hangs: int = 0
    killed_for_hanging: bool = False
    causes: list[str] = field(default_factory=list)
    watched_step: tuple[int, int] = (-1, -1)
    cpu_at_step_s: float = 0.0

    def kill(self) -> None:
        """Kill the process; never another one that got its pid."""
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(self.pidfd, signal.SIGKILL)

    def buried(self) -> None:
        """Note that the process has ended and was reaped."""
        self.alive = False
        os.close(self.pidfd)

    @property
    def log_tail(self) -> str:
        """The last line that the process wrote."""
        lines = self.log.read_text(errors="replace").strip().splitlines() if self.log.exists() else []
        return lines[-1] if lines else "no output"

    def _guards(self, acted: list[int]) -> dict[str, int]:
        counts = dict(zip(self.guards, acted, strict=False))
        counts["restart"] = max(self.life, 0)
        return {name: times for name, times in counts.items() if times}

    def report(self, result: NodeResult, end_ns: int) -> NodeReport:
        """The node's report for the outcome of a flight that ended at this virtual time."""
        page, counts = self.stats.page, self.stats.counts(end_ns)
        # Of the call that ends later nothing comes in the flight, and it need not have begun.
        late = page["end_ns"] > end_ns
        calls = (page["invocations"] - late).tolist()
        return NodeReport(
            result=result,
            crashes=self.crashes,
            hangs=self.hangs,
            restarts=max(self.life, 0),
            causes=self.causes,
            steps=int(counts["steps"]),
            dropped=int(counts["dropped"]),
            late=int(page["late"]),
            malformed=int(counts["malformed"] + page["unreadable"]),
            outdated=int(counts["outdated"] + page["doubled"]),
            alarms=int(counts["alarms"]),
            recomputed=int(counts["recomputed"]),
            ungated=int(counts["ungated"]),
            lost=int(counts["lost"]),
            guards=self._guards(counts["guards"].tolist()),
            compute_s=int(page["wall_ns"][COMPUTING]) / 1e9,
            messaging_s=int(page["wall_ns"][MESSAGING]) / 1e9,
            waiting_s=int(page["wall_ns"][WAITING]) / 1e9,
            kernels={
                name: KernelUse(
                    invocations=calls[i],
                    cpu_ns=int(page["cpu_ns"][i]),
                    cpu_squares_ns2=float(page["cpu_squares_ns2"][i]),
                )
                for i, name in enumerate(self.kernels)
                if calls[i] > 0
            },
        )


class Supervisor:
    """Starts the processes of a mission on a fork server and watches them."""

    def __init__(
        self,
        server: ForkServer,
        address: BusAddress,
        hang_cpu_s: float,
        *,
        traced: str = "",
        armed: Trigger | None = None,
    ) -> None:
        """Start nobody yet; the node of that name, if any, is traced as long as it lives.

        ``armed`` is the call in which the fault's node is to stop.
        """
        self._armed = armed
        self._server = server
        self._traced = traced
        self._address = address
        self._hang_cpu_s = hang_cpu_s
        self.members: dict[str, SupervisedNode] = {}
        self._tracer_pid = 0

    def start(self, process: ProcessDeclaration, setup: NodeSetup) -> SupervisedNode:
        """Start a process, for the first time or again."""
        member = self.members.get(process.name)
        if member is None:
            log = self._address.folder / f"{process.name}.log"
            guards = numbered(setup.spec.active_guards)
            member = SupervisedNode(process, SharedStats.create(process.name), log, setup.kernels, guards)
            if self._armed is not None:
                member.stats.arm(self._armed.invocation, self._armed.after_ns)
            self.members[process.name] = member
        descriptor = os.open(member.log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        try:
            forked = self._server.spawn(setup, self._address, member.stats, descriptor, self._tracer_pid)
        finally:
            os.close(descriptor)
        member.pid, member.pidfd = forked.pid, forked.pidfd
        member.life = setup.life
        member.alive = True
        if process.with_fault:
            self._tracer_pid = member.pid
        return member

    def deaths(self) -> list[tuple[SupervisedNode, Exited]]:
        """The members that ended since the last call, crashes and hangs counted.

        :raises DisturbedFlightError: if another process has ended one.
        :raises InfrastructureError: if a proxy of ours has failed.
        """
        by_pid = {member.pid: member for member in self.members.values() if member.alive}
        ended = [(by_pid[exited.pid], exited) for exited in self._server.exits() if exited.pid in by_pid]
        for member, _ in ended:  # all of them before an error: nobody is told of an end twice
            member.buried()
        for member, exited in ended:
            if exited.by_another and not member.killed_for_hanging:
                raise DisturbedFlightError(_ended_from_outside(member, exited))
            if exited.status == EXIT_REAPER:
                message = f"the proxy of {member.process.name} failed: {member.log_tail}"
                raise InfrastructureError(message)
            if exited.status != 0:
                self._count(member, exited.status)
        return ended

    def _count(self, member: SupervisedNode, status: int) -> None:
        if member.killed_for_hanging:
            member.hangs += 1
            member.causes.append("hang")
            member.killed_for_hanging = False
            return
        member.crashes += 1
        if status == EXIT_BUG:
            member.causes.append(member.log_tail)
        elif status == EXIT_NONSENSE:
            member.causes.append("nonsense")
        else:
            member.causes.append(signal_name(-status) if status < 0 else f"exit status {status}")

    def kill_hung(self) -> None:
        """Kill the nodes whose present step has used more thread time than a hang is granted.

        Thread time, not wall time: a loaded machine makes nobody hang. Nor does who traces a node: it is
        traced until the fault strikes, and up to there does what its golden twin does. One in which a fault
        recurs is traced all the time, and may hang as any other.
        """
        for member in self.members.values():
            page = member.stats.page
            if not (member.alive and page["computing"]):
                member.watched_step = (-1, -1)
                continue
            step = (member.life, int(page["steps"]))
            pid = int(page["program"]) or member.pid
            used_s = thread_cpu_s(pid)
            follows_its_twin = member.process.name != self._traced and tracer_of(pid)
            if step != member.watched_step or follows_its_twin:
                member.watched_step, member.cpu_at_step_s = step, used_s
            elif used_s - member.cpu_at_step_s > self._hang_cpu_s:
                self.kill_as_hung(member)

    def kill_as_hung(self, member: SupervisedNode) -> None:
        """Kill a node; its end will be counted as a hang."""
        if member.alive:
            member.killed_for_hanging = True
            member.kill()

    def refresh(self) -> list[str]:
        """Have the counters of all members be what they are now, as shared pages are anyway.

        The processes that somebody has stopped (SIGSTOP): nodes and sidecars by name, and proxies.
        """
        alive = [member for member in self.members.values() if member.alive]
        nodes = [member.process.name for member in alive if is_stopped(member.pid)]
        proxies = [one.process.name for one in alive if is_stopped(self._server.reaper_of(one.pid))]
        return nodes + [f"the proxy of {name}" for name in proxies]

    def pids(self) -> list[int]:
        """The processes that are alive: nodes with the programs that they run, sidecars, proxies."""
        alive = [member for member in self.members.values() if member.alive]
        programs = [int(member.stats.page["program"]) for member in alive]
        proxies = [self._server.reaper_of(member.pid) for member in alive]
        return [pid for pid in (*(member.pid for member in alive), *programs, *proxies) if pid > 0]

    def cpu_s(self) -> float:
        """Processor time of the nodes that are alive, with the programs that they run; of sidecars none."""
        nodes = [one for one in self.members.values() if one.alive and not one.process.sidecar]
        used_s = 0.0
        for pid in (pid for one in nodes for pid in (one.pid, int(one.stats.page["program"])) if pid > 0):
            with contextlib.suppress(OSError):  # it has just ended
                used_s += process_stat(pid).cpu_s
        return used_s

    def end(self, grace_s: float, meanwhile: Callable[[], object]) -> None:
        """Wait for the members to end by themselves, calling ``meanwhile`` again and again; kill the rest.

        One at the injector's gate has so long from when it has passed.

        :raises InfrastructureError: if one is left for ever, as if its proxy is stopped.
        """
        begin_s = time.monotonic()
        deadline_s, killed = begin_s + grace_s, False
        while left := [member for member in self.members.values() if member.alive]:
            now_s = time.monotonic()
            if now_s > begin_s + LEFT_S:
                names = ", ".join(member.process.name for member in left)
                raise InfrastructureError(f"{names}: not gone {LEFT_S:g} s after the mission")
            if any(one.stats.page["gated"] for one in left):
                deadline_s = now_s + grace_s
            if now_s > deadline_s and not killed:
                for member in left:
                    member.kill()
                killed = True
            for exited in self._server.exits():
                for member in left:
                    if member.pid == exited.pid:
                        member.buried()
            meanwhile()

    def close(self) -> None:
        """Kill all processes that are left and free their shared pages."""
        for member in self.members.values():
            if member.alive:
                self._server.discard(member.pid)
        try:
            self.end(0.0, lambda: time.sleep(0.001))
        finally:
            for member in self.members.values():
                member.stats.close()


def _ended_from_outside(member: SupervisedNode, exited: Exited) -> str:
    if exited.status == EXIT_REAPER:
        return f"the proxy of {member.process.name} was killed from outside"
    return f"{member.process.name} was ended from outside ({signal_name(-exited.status)})"


def thread_cpu_s(pid: int) -> float:
    """User and system time of a process's main thread, 0 if it is gone."""
    try:
        return main_thread_stat(pid).cpu_s
    except OSError:
        return 0.0
