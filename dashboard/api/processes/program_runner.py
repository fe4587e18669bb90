"""Has the studies of programs made, one at a time, in the order in which they were asked for.

It is a lane beside those of campaigns and flights: a study does not wait for a campaign, and they share the
processors. What is to be made stands in the folder of the studies, so the next life of the service goes on.
"""

from __future__ import annotations

import fcntl
import logging
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import IO, Literal

from dashboard.api.processes.campaign_runner import FAILURES, GRACE_S, LOOK_S, LaneState
from dashboard.api.processes.event_bus import EventBus
from dashboard.api.processes.events import ProcessEvent
from dashboard.api.processes.program_studies import LOG, ProgramStudies, StudyEntry

WATCH_S = 0.2
"""Interval at which a study that is being made is looked at: whether it has ended, or is to be left."""

LOG_BYTES = 4000
"""Of the end of a log that are read for why a process has failed."""

logger = logging.getLogger("zenfi.programs")


class ProgramRunner:
    """Starts and ends the processes that make studies; ``slots`` is the most that one may have at a time."""

    def __init__(self, studies: ProgramStudies, event_bus: EventBus, slots: int | None) -> None:
        self.studies = studies
        self.slots = slots or len(os.sched_getaffinity(0))
        self._event_bus = event_bus
        self._failures = 0
        self._leaving, self._notified = threading.Event(), threading.Event()
        self._making = ""
        self._process: subprocess.Popen[bytes] | None = None
        self._lock: IO[bytes] | None = None
        # The process dies with the thread that started it: this one, which lives as long as the service.
        self._thread = threading.Thread(target=self._work, name="lane-programs", daemon=True)

    def start(self) -> None:
        """Start the thread, which has the studies in the folder made."""
        self._thread.start()

    def notify(self) -> None:
        """Have the folder read now, as the phase of a study has changed."""
        self._notified.set()

    def leave(self) -> None:
        """Start nothing more; have the process leave its study: the service's next life goes on."""
        self._leaving.set()
        self._notified.set()

    def stop(self) -> None:
        """Have the process end, and wait for it; kill it if it does not."""
        self.leave()
        if self._thread.is_alive():
            self._thread.join(GRACE_S)
        process = self._process
        if process is not None:
            process.kill()
        if self._thread.is_alive():
            self._thread.join()

    @property
    def state(self) -> LaneState:
        """The state of the lane: which study it makes, and whether its thread lives."""
        return LaneState(
            name="programs", alive=self._thread.is_alive(), flying=self._making, failures=self._failures
        )

    @property
    def processes(self) -> dict[str, int]:
        """The pid of the process of the study that is being made, by the study's label."""
        process = self._process
        return {self._making: process.pid} if process is not None else {}

    def _work(self) -> None:
        while not self._leaving.is_set():
            self._notified.clear()
            entry = None
            try:
                entry = self._next()
                if entry is not None:
                    self._make(entry)
            except Exception:  # the service outlives a bad moment of the disk
                logger.exception("studies of programs cannot be made")
                entry = None
            if entry is None:
                self._notified.wait(LOOK_S)

    def _next(self) -> StudyEntry | None:
        queued = [one for one in reversed(self.studies.entries()) if one.phase == "queued"]
        if not queued or not self._owns():
            return None
        for entry in queued:
            if self.studies.is_allowed(entry):
                return entry
            why = f"{entry.program} is no longer a program that may be struck (--programs), or another one"
            self.studies.move(entry.label, "paused", of=("queued",), reason=why)
        return None

    def _owns(self) -> bool:
        """Whether this service has the studies of the folder made; another one may be at it."""
        if self._lock is None:
            lock = (self.studies.folder / "runner.lock").open("ab")
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                lock.close()
                return False
            self._lock = lock
        return True

    def _make(self, entry: StudyEntry) -> None:
        label, before = entry.label, self.studies.count(entry.label)
        status = self._watched(entry)
        if status == 0:
            self._failures = 0
            self.studies.move(label, "done", of=("queued",))
        elif status == 130 or self._leaving.is_set():
            self._failures = 0
        elif status == 2:
            self._failures = 0
            self.studies.move(label, "failed", of=("queued",), reason=self._last_words(label))
        else:
            self._failures = 1 if self.studies.count(label) > before else self._failures + 1
            if self._failures < FAILURES:
                self._leaving.wait(2.0**self._failures - 1)
                return
            self._failures = 0
            why = f"its process died {FAILURES} times: {self._last_words(label)}"
            self.studies.move(label, "failed", of=("queued",), reason=why)

    def _watched(self, entry: StudyEntry) -> int:
        """Have a study made until all is made or it is to be left; the exit status of its process."""
        process = self._started(self.studies.folder / entry.label, min(entry.slots or self.slots, self.slots))
        self._making, self._process = entry.label, process
        self._tell(entry.label, process.pid, "running")
        told = False
        try:
            while process.poll() is None:
                self._notified.clear()
                if not told and (self._leaving.is_set() or not self._is_wanted(entry.label)):
                    process.send_signal(signal.SIGTERM)
                    told = True
                self._notified.wait(WATCH_S)
        except BaseException:
            process.kill()
            process.wait()
            raise
        finally:
            self._making, self._process = "", None
        self._tell(entry.label, process.pid, "ended", process.returncode)
        return process.returncode

    def _is_wanted(self, label: str) -> bool:
        entry = self.studies.find(label)
        return entry is not None and entry.phase == "queued"

    def _started(self, folder: Path, slots: int) -> subprocess.Popen[bytes]:
        own = [sys.executable, "-P", "-m", "dashboard.api.processes.program_process"]
        with (folder / LOG).open("ab") as log:
            return subprocess.Popen(  # noqa: S603 - our own interpreter and module
                [*own, str(os.getpid()), str(folder.resolve()), str(slots)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=log,
                start_new_session=True,
            )

    def _last_words(self, label: str) -> str:
        """The last line of the log of a study."""
        content = (self.studies.folder / label / LOG).read_bytes()[-LOG_BYTES:]
        lines = content.decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it says nothing"

    def _tell(
        self, label: str, pid: int, state: Literal["running", "ended"], status: int | None = None
    ) -> None:
        event = ProcessEvent(name=f"program study {label}", pid=pid, state=state, status=status)
        logger.info("%s %s", event.name, state, extra={"pid": pid, "status": status})
        self._event_bus.publish("process", event.model_dump_json(), "", f"process {event.name}")
        if state == "ended":
            self._event_bus.forget(f"process {event.name}")
