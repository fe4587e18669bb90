"""The processes that run now: starts them, reads their output and reports their events; no policy."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from collections.abc import Callable, Mapping
from pathlib import Path

from deploy.compose.bus import StackBus
from deploy.compose.events import Ended, Event, Launch, Launched, NotAlive, NotLaunched, SignsSeen
from deploy.compose.folder import log_file
from deploy.compose.limits import over_memory
from deploy.compose.logs import READ_BYTES, Log
from deploy.compose.probes import LivenessWatch, ReadinessWatch
from deploy.compose.process import SupervisedProcess
from deploy.compose.stack_file import LogLimits
from deploy.compose.system.process_tree import kill_strays, reaped

FLOOD_PAUSE_S = 0.02
"""How long a process that writes more than it may is not read: at most 3 MB/s are read, then it waits."""

STRAYS_PAUSE_S = 0.005


class SupervisedProcesses:
    """Reapers by the name of their process. ``strays`` counts processes that lost their reaper."""

    def __init__(self, folder: Path, logs: Path, bus: StackBus, tell: Callable[[Event], None]) -> None:
        self._folder, self._logs, self._bus, self._tell = folder, logs, bus, tell
        self._loop = asyncio.get_running_loop()
        self._watches: dict[str, ReadinessWatch] = {}
        self._probes: dict[str, LivenessWatch] = {}
        self._statuses: dict[int, int] = {}
        self.now: dict[str, SupervisedProcess] = {}
        self.logs: dict[str, Log] = {}
        self.cleared: dict[str, int] = {}
        self.unkilled: dict[str, int] = {}
        self.strays = 0
        self._loop.add_signal_handler(signal.SIGCHLD, self._reap)

    def log(self, name: str, limits: LogLimits) -> Log:
        """The log of a process, opened if it is not."""
        if name not in self.logs:
            self.logs[name] = Log(log_file(self._logs, name), limits)
        self.logs[name].limits = limits
        return self.logs[name]

    def launch(self, order: Launch, environment: Mapping[str, str]) -> None:
        """Start a process under a reaper of its own."""
        name = order.name
        try:
            log = self.log(name, order.spec.log)
            process = SupervisedProcess(order.life, order.spec, environment)
        except OSError as error:
            self._loop.call_soon(self._tell, NotLaunched(name, order.life, f"not started: {error}"))
            return
        self.now[name] = process
        self._loop.add_reader(process.channel, self._hear, name, process)
        self._loop.add_reader(process.output, self._read, process, log)
        if order.spec.ready.signs:
            self._watches[name] = ReadinessWatch(
                process, self._bus, lambda: self._tell(SignsSeen(name, process.number))
            )

    def probe(self, name: str) -> None:
        """Probe from now on whether a process works."""
        process = self.now.get(name)
        if process is not None and process.spec.alive is not None:
            self._probes[name] = LivenessWatch(
                process,
                process.spec.alive,
                self._bus,
                lambda reason: self._tell(NotAlive(name, process.number, reason)),
            )

    def failed_probes(self, name: str) -> int:
        """How many probes of a process in a row have failed."""
        return self._probes[name].failed if name in self._probes else 0

    def hold_limits(self) -> None:
        """Kill the processes whose families are over their limits."""
        for process in self.now.values():
            if not process.over_limit and (reason := over_memory(process)):
                process.over_limit = reason
                process.kill()

    def announced(self) -> None:
        """Check all processes for their announcement, since one has appeared on the bus."""
        for watch in list(self._watches.values()):
            watch.look_for_announcement()

    def send(self, name: str, number: int) -> None:
        """Send a signal to a process and stop watching and probing it."""
        self._unwatch(name)
        if name in self.now:
            self.now[name].send(number)

    def kill_all(self) -> None:
        """Kill every process and its family."""
        for process in self.now.values():
            process.kill()

    def close(self) -> None:
        """Free everything; reapers that still run then end their families and themselves."""
        self._loop.remove_signal_handler(signal.SIGCHLD)
        for name in (*self._watches, *self._probes):
            self._unwatch(name)
        for process in self.now.values():
            self._loop.remove_reader(process.channel)
            self._loop.remove_reader(process.output)
            process.close()
        for log in self.logs.values():
            log.close()

    def _unwatch(self, name: str) -> None:
        for watch in (self._watches.pop(name, None), self._probes.pop(name, None)):
            if watch is not None:
                watch.close()

    # -- what is heard -----------------------------------------------------------------------------

    def _hear(self, name: str, process: SupervisedProcess) -> None:
        with contextlib.suppress(BlockingIOError):
            if not self._hears_on(name, process):
                self._loop.remove_reader(process.channel)

    def _read(self, process: SupervisedProcess, log: Log) -> None:
        try:
            data = os.read(process.output, READ_BYTES)
        except BlockingIOError:
            return
        if not data:
            self._loop.remove_reader(process.output)
        elif not log.take(data):
            self._loop.remove_reader(process.output)
            self._loop.call_later(FLOOD_PAUSE_S, self._read_on, process, log)

    def _read_on(self, process: SupervisedProcess, log: Log) -> None:
        if process in self.now.values():
            self._loop.add_reader(process.output, self._read, process, log)

    # -- what ends ---------------------------------------------------------------------------------

    def _reap(self) -> None:
        reapers = {process.reaper: name for name, process in self.now.items()}
        for pid, status in reaped():
            if pid in reapers:
                self._bury(reapers[pid], status)

    def _bury(self, name: str, status: int) -> None:
        """Handle the end of a reaper: regular, after its process, or killed by somebody."""
        process = self.now[name]
        with contextlib.suppress(BlockingIOError):
            while self._hears_on(name, process):
                pass
        if process.status is None and not process.error:
            # Its process dies with it; the rest of the family is now ours, and must go before all else.
            others = {one.reaper for one in self.now.values()}
            killed, process.refused = kill_strays(others)
            self.strays += killed
            if killed:
                self._loop.call_later(STRAYS_PAUSE_S, self._bury, name, status)
                return
            process.status = status
        self._drain(name, process)
        self._unwatch(name)
        self._loop.remove_reader(process.channel)
        self._loop.remove_reader(process.output)
        process.close()
        del self.now[name]
        self.cleared[name] = self.cleared.get(name, 0) + process.killed
        self.unkilled[name] = self.unkilled.get(name, 0) + process.refused
        if process.error:
            self._tell(NotLaunched(name, process.number, process.error))
        else:
            self._tell(Ended(name, process.number, process.status or 0, process.over_limit))

    def _hears_on(self, name: str, process: SupervisedProcess) -> bool:
        """Take in one report of a reaper; False if there will be no more."""
        before = process.pid
        more = process.hear()
        if process.pid != before:
            self._tell(Launched(name, process.number))
        return more

    def _drain(self, name: str, process: SupervisedProcess) -> None:
        """Read what was written last: at most what a pipe holds, for the writers are gone."""
        try:
            while data := os.read(process.output, READ_BYTES):
                self.logs[name].take(data)
        except BlockingIOError:
            pass
        self.logs[name].end_line()
