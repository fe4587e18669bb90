"""The processes that run now: started, listened to, buried. Tells events, knows no policy."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from collections.abc import Callable, Mapping
from pathlib import Path

from deploy.compose.bus import StackBus
from deploy.compose.events import Ended, Event, Launch, Launched, NotLaunched, Seen
from deploy.compose.family import kill_strays, reaped
from deploy.compose.folder import log_file
from deploy.compose.life import Life
from deploy.compose.logs import READ_BYTES, Log
from deploy.compose.readiness import Watch
from deploy.compose.stack_file import LogLimits

FLOOD_PAUSE_S = 0.02
"""How long a process that writes more than it may is not read: at most 3 MB/s are read, then it waits."""

STRAYS_PAUSE_S = 0.005


class Lives:
    """Keepers by the name of their process. ``strays`` counts processes that lost their keeper."""

    def __init__(self, folder: Path, logs: Path, bus: StackBus, tell: Callable[[Event], None]) -> None:
        self._folder, self._logs, self._bus, self._tell = folder, logs, bus, tell
        self._loop = asyncio.get_running_loop()
        self._watches: dict[str, Watch] = {}
        self._statuses: dict[int, int] = {}
        self.now: dict[str, Life] = {}
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
        """Start a process under a keeper of its own."""
        name = order.name
        try:
            log = self.log(name, order.spec.log)
            life = Life(order.life, order.spec, environment)
        except OSError as error:
            self._loop.call_soon(self._tell, NotLaunched(name, order.life, f"not started: {error}"))
            return
        self.now[name] = life
        self._loop.add_reader(life.channel, self._hear, name, life)
        self._loop.add_reader(life.output, self._read, life, log)
        if order.spec.ready.signs:
            self._watches[name] = Watch(life, self._bus, lambda: self._tell(Seen(name, life.number)))

    def announced(self) -> None:
        """Somebody has announced itself on the bus."""
        for watch in list(self._watches.values()):
            watch.look_for_announcement()

    def send(self, name: str, number: int) -> None:
        """Send a signal to a process."""
        self._unwatch(name)
        if name in self.now:
            self.now[name].send(number)

    def kill_all(self) -> None:
        """Kill every process and its family."""
        for life in self.now.values():
            life.kill()

    def close(self) -> None:
        """Free everything; keepers that still live end their families and themselves."""
        self._loop.remove_signal_handler(signal.SIGCHLD)
        for name in list(self._watches):
            self._unwatch(name)
        for life in self.now.values():
            self._loop.remove_reader(life.channel)
            self._loop.remove_reader(life.output)
            life.close()
        for log in self.logs.values():
            log.close()

    def _unwatch(self, name: str) -> None:
        watch = self._watches.pop(name, None)
        if watch is not None:
            watch.close()

    # -- what is heard -----------------------------------------------------------------------------

    def _hear(self, name: str, life: Life) -> None:
        with contextlib.suppress(BlockingIOError):
            if not self._hears_on(name, life):
                self._loop.remove_reader(life.channel)

    def _read(self, life: Life, log: Log) -> None:
        try:
            data = os.read(life.output, READ_BYTES)
        except BlockingIOError:
            return
        if not data:
            self._loop.remove_reader(life.output)
        elif not log.take(data):
            self._loop.remove_reader(life.output)
            self._loop.call_later(FLOOD_PAUSE_S, self._read_on, life, log)

    def _read_on(self, life: Life, log: Log) -> None:
        if life in self.now.values():
            self._loop.add_reader(life.output, self._read, life, log)

    # -- what ends ---------------------------------------------------------------------------------

    def _reap(self) -> None:
        keepers = {life.keeper: name for name, life in self.now.items()}
        for pid, status in reaped():
            if pid in keepers:
                self._bury(keepers[pid], status)

    def _bury(self, name: str, status: int) -> None:
        """A keeper has ended: as it should, after its process, or killed by somebody."""
        life = self.now[name]
        with contextlib.suppress(BlockingIOError):
            while self._hears_on(name, life):
                pass
        if life.status is None and not life.error:
            # Its process dies with it; the rest of the family is now ours, and must go before all else.
            others = {one.keeper for one in self.now.values()}
            killed, life.refused = kill_strays(others)
            self.strays += killed
            if killed:
                self._loop.call_later(STRAYS_PAUSE_S, self._bury, name, status)
                return
            life.status = status
        self._drain(name, life)
        self._unwatch(name)
        self._loop.remove_reader(life.channel)
        self._loop.remove_reader(life.output)
        life.close()
        del self.now[name]
        self.cleared[name] = self.cleared.get(name, 0) + life.killed
        self.unkilled[name] = self.unkilled.get(name, 0) + life.refused
        if life.error:
            self._tell(NotLaunched(name, life.number, life.error))
        else:
            self._tell(Ended(name, life.number, life.status or 0))

    def _hears_on(self, name: str, life: Life) -> bool:
        """Take in one report of a keeper; False if there will be none any more."""
        before = life.pid
        more = life.hear()
        if life.pid != before:
            self._tell(Launched(name, life.number))
        return more

    def _drain(self, name: str, life: Life) -> None:
        """What was written last: at most what a pipe holds, for the writers are gone."""
        try:
            while data := os.read(life.output, READ_BYTES):
                self.logs[name].take(data)
        except BlockingIOError:
            pass
        self.logs[name].end_line()
