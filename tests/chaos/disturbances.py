"""Disturbances of what flies a campaign: of any of its processes, of its disk, of its files; by a seed."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from services.runtime import rng
from tests.chaos.processes import by_class

KINDS = ("killed", "stopped", "slowed")
"""What becomes of a process."""

FILES = ("store's file", "recording", "mission's file", "flown outcome")
"""What may be gone; the disk may be full."""

DISK = "disk"
AT_ONCE = 2
"""Disturbances at a time."""

AWAY_S = 3.0
"""For so long the store's file is elsewhere; nothing else is disturbed meanwhile."""

RUN_S, REST_S = 0.01, 0.09
"""A process that is slowed runs for so long, and then does not."""


@dataclass(frozen=True)
class Disturbance:
    """What was done, to what, and the runs that were being flown then."""

    kind: str
    of: str
    what: str
    runs: frozenset[int]


@dataclass(frozen=True)
class Places:
    """Where the files of a campaign are. ``disk`` is the mount point of a small disk of its own."""

    disk: Path
    store: Path
    missions: Path


@contextmanager
def small_disk(folder: Path, size_mb: int) -> Iterator[Path]:
    """A disk of that size, which is to be had as root alone; gone at the end."""
    folder.mkdir()
    options = ["-t", "tmpfs", "-o", f"size={size_mb}m,mode=0711", "zenfi-chaos", str(folder)]
    subprocess.run(["mount", *options], check=True)  # noqa: S607
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)  # noqa: S607
        folder.rmdir()


class Chaos:
    """Disturbs what is there, drawn by ``seed``: the class first, then which of it, and what befalls it."""

    def __init__(
        self, places: Places, classes: Mapping[str, int], seed: int, hold_s: float, files: tuple[str, ...]
    ) -> None:
        """``classes`` tells how often a class is drawn, ``files`` are once each; others are left alone."""
        self._places, self._hold_s = places, hold_s
        self._weights = {**classes, **dict.fromkeys(files, 1)}
        self._draw = rng.generator(seed, "chaos")
        self._end = threading.Event()
        self._pool = ThreadPoolExecutor(AT_ONCE, "disturbance")
        self._under_way: list[Future[None]] = []
        self._alone = False
        self.done: list[Disturbance] = []

    @property
    def under_way(self) -> int:
        """How many disturbances have not ended."""
        self._under_way = [one for one in self._under_way if not one.done()]
        return len(self._under_way)

    def another(self, runs: frozenset[int], finished: frozenset[int]) -> Disturbance | None:
        """Disturb something, unless enough is disturbed; None if nothing of the drawn class is there."""
        under_way = self.under_way
        self._alone = self._alone and under_way > 0
        if under_way >= AT_ONCE or self._alone:
            return None
        names = sorted(self._weights)
        total = sum(self._weights.values())
        drawn = str(self._draw.choice(names, p=[self._weights[name] / total for name in names]))
        present = by_class(os.getpid())
        if drawn in present:
            begun = self._process(drawn, present[drawn])
        elif drawn == DISK:
            begun = self._full()
        else:
            begun = self._gone(drawn, under_way, finished) if drawn in FILES else None
        if begun is None:
            return None
        kind, what, act = begun
        self._under_way.append(self._pool.submit(act))
        self.done.append(Disturbance(kind, drawn, what, runs))
        return self.done[-1]

    def close(self) -> None:
        """End all disturbances."""
        self._end.set()
        self._pool.shutdown()
        for one in self._under_way:
            one.result()

    def _process(self, of: str, pids: list[int]) -> tuple[str, str, Callable[[], None]] | None:
        pid, kind = int(self._draw.choice(pids)), str(self._draw.choice(KINDS))
        try:
            descriptor = os.pidfd_open(pid)
            name = Path(f"/proc/{pid}/comm").read_text().strip()
        except OSError:
            return None
        return kind, f"{of} {pid} ({name})", lambda: self._signal(descriptor, kind)

    def _signal(self, descriptor: int, kind: str) -> None:
        """What befalls the process of a descriptor, which is closed."""

        def send(number: signal.Signals) -> None:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(descriptor, number)

        until_s = time.monotonic() + self._hold_s
        try:
            if kind == "killed":
                send(signal.SIGKILL)
            elif kind == "stopped":
                send(signal.SIGSTOP)
                self._end.wait(self._hold_s)
            while kind == "slowed" and time.monotonic() < until_s and not self._end.is_set():
                send(signal.SIGSTOP)
                self._end.wait(REST_S)
                send(signal.SIGCONT)
                self._end.wait(RUN_S)
        finally:
            send(signal.SIGCONT)
            os.close(descriptor)

    def _full(self) -> tuple[str, str, Callable[[], None]] | None:
        ballast = self._places.disk / "ballast"
        return None if ballast.exists() else ("full", str(self._places.disk), lambda: self._fill(ballast))

    def _fill(self, ballast: Path) -> None:
        with ballast.open("wb") as file:
            with suppress(OSError):  # others take of the same room
                os.posix_fallocate(file.fileno(), 0, shutil.disk_usage(self._places.disk).free)
            self._end.wait(self._hold_s)
        ballast.unlink()

    def _gone(
        self, of: str, under_way: int, finished: frozenset[int]
    ) -> tuple[str, str, Callable[[], None]] | None:
        store = self._places.store
        if of == "store's file":
            file = store / "zenfi.sqlite"
            self._alone = not under_way and file.exists()
            return ("gone", str(file), lambda: self._away(file)) if self._alone else None
        found = {
            "recording": [one for one in store.glob("artefacts/*/run-*.mcap") if _run(one) not in finished],
            "mission's file": [one for one in self._places.missions.glob("zenfi-*/*") if not one.is_dir()],
            "flown outcome": list(store.glob("flown/*.json")),
        }[of]
        if not found:
            return None
        path = sorted(found)[int(self._draw.integers(len(found)))]
        return "gone", str(path), lambda: path.unlink(missing_ok=True)

    def _away(self, file: Path) -> None:
        elsewhere = file.with_name("elsewhere")
        file.rename(elsewhere)
        self._end.wait(AWAY_S)
        elsewhere.rename(file)


def _run(recording: Path) -> int:
    return int(recording.stem.removeprefix("run-"))
