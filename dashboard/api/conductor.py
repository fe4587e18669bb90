"""Keeps a pilot flying as long as some campaign is wanted; survives what pilots die of.

There are two lanes, each with one pilot at a time: campaigns, and single flights, which do not wait
for campaigns. What is wanted is in the store alone, so a new life of the service goes on where the last
one was killed.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Literal

from dashboard.api.events import ProcessEvent
from dashboard.api.hub import Hub
from dashboard.campaigns import steering
from dashboard.campaigns.listing import line
from dashboard.campaigns.spec import CampaignSpec, cells
from dashboard.campaigns.store import BusyError, Campaign, Store
from deploy.check import BadSpecError
from deploy.sight import Sight

LOOK_S = 2.0
"""Between two looks at what is wanted; who wants something may also knock."""

FAILURES = 5
"""In a row, after which a campaign is left to people: of its pilots to fly a run, or of its set-up."""

GRACE_S = 15.0
"""A pilot that is told to leave writes down where it was."""

logger = logging.getLogger("zenfi.conductor")


def is_flight(spec: CampaignSpec) -> bool:
    """Whether a campaign is a single flight."""
    return len(cells(spec)) * spec.runs == 1


class Conductor:
    """Starts and ends the pilots. ``stop`` pauses what is flown."""

    def __init__(self, store: Store, hub: Hub, slots: int | None) -> None:
        self._hub = hub
        self.given_up: dict[str, str] = {}
        self._sights: dict[int, str] = {}
        self._lanes = [
            _Lane("campaigns", self, store, hub, lambda spec: not is_flight(spec), slots),
            _Lane("flights", self, store, hub, is_flight, 1),
        ]

    def start(self) -> None:
        """Take up what is wanted."""
        for lane in self._lanes:
            lane.thread.start()

    def knock(self, label: str) -> None:
        """Something is newly wanted."""
        self.given_up.pop(label, None)
        for lane in self._lanes:
            lane.knocked.set()

    def sight(self, run: int) -> Sight | None:
        """What a run's flight sees, None if it is not under way or has seen nothing yet."""
        told = self._sights.get(run)
        return Sight.model_validate_json(told) if told is not None else None

    def see(self, run: int, told: str | None) -> None:
        """Keep what a flight sees, as JSON; None: it is over."""
        if told is None:
            self._sights.pop(run, None)
        else:
            self._sights[run] = told

    def stop(self) -> None:
        """Have the pilots leave, and wait for them."""
        for lane in self._lanes:
            lane.leave()
        for lane in self._lanes:
            lane.end(GRACE_S)

    @property
    def working(self) -> bool:
        """Whether both lanes are looked after."""
        return all(lane.thread.is_alive() for lane in self._lanes)

    @property
    def pilots(self) -> dict[str, int]:
        """The pid of the pilot of each campaign that is flown."""
        return {lane.flying: lane.pilot.pid for lane in self._lanes if lane.pilot is not None}


class _Lane:
    def __init__(
        self,
        name: str,
        conductor: Conductor,
        store: Store,
        hub: Hub,
        mine: Callable[[CampaignSpec], bool],
        slots: int | None,
    ) -> None:
        self._store, self._hub, self._mine = store, hub, mine
        self._given_up, self._see = conductor.given_up, conductor.see
        self._slots = slots
        self._failures = 0
        self._leaving = threading.Event()
        self.knocked = threading.Event()
        self.flying = ""
        self.pilot: subprocess.Popen[bytes] | None = None
        # A pilot dies with the thread that started it: this one, which lives as long as the service.
        self.thread = threading.Thread(target=self._work, name=f"lane-{name}", daemon=True)

    def leave(self) -> None:
        """Start nothing more; have the pilot pause its campaign."""
        self._leaving.set()
        self.knocked.set()
        pilot = self.pilot
        if pilot is not None:
            pilot.send_signal(signal.SIGTERM)

    def end(self, grace_s: float) -> None:
        """Wait for the pilot; kill it if it does not leave."""
        self.thread.join(grace_s)
        pilot = self.pilot
        if pilot is not None:
            pilot.kill()
        self.thread.join()

    def _work(self) -> None:
        while not self._leaving.is_set():
            self.knocked.clear()
            try:
                found = self._next()
                if found is not None:
                    self._fly(found)
            except Exception:  # the service outlives a bad moment of the store
                logger.exception("the store does not answer")
                found = None
            if found is None:
                self.knocked.wait(LOOK_S)

    def _next(self) -> Campaign | None:
        wanted = self._store.wanted()
        mine = (one for one in wanted if self._mine(one.spec) and one.label not in self._given_up)
        return next(mine, None)

    def _fly(self, found: Campaign) -> None:
        before = self._store.progress(found)["done"]
        try:
            pilot = self._started(found)
        except (OSError, BadSpecError) as error:
            self._not_begun(found, str(error))
            return
        status = self._watched(pilot, found.label)
        if status in (0, 130) or self._leaving.is_set():
            self._failures = 0
            return
        self._failures = 1 if self._store.progress(found)["done"] > before else self._failures + 1
        if self._failures >= FAILURES:
            self._failures = 0
            self._given_up[found.label] = f"its pilot died {FAILURES} times: see its log"
            self._tell(found.label, 0, "given up")
        else:
            self._leaving.wait(2.0**self._failures - 1)

    def _not_begun(self, found: Campaign, why: str) -> None:
        """Try again in a while, but not for ever: others wait behind it."""
        logger.warning("%s cannot be set up: %s", found.label, why)
        self._failures += 1
        if self._failures < FAILURES:
            self._leaving.wait(2.0**self._failures - 1)
            return
        self._failures = 0
        try:
            steering.give_up(self._store, found, f"it cannot be set up: {why}")
        except BusyError as error:
            self._given_up[found.label] = str(error)
        stands = line(self._store, self._store.find(found.label))
        self._hub.publish("campaign", stands.model_dump_json(), found.label, f"campaign {found.label}")

    def _started(self, found: Campaign) -> subprocess.Popen[bytes]:
        """The pilot of a campaign.

        :raises OSError, BadSpecError: if it has no folder, or no process can be started.
        """
        log = self._store.artefacts(found) / "pilot.log"
        arguments = [str(os.getpid()), found.label]
        arguments += [str(self._slots)] if self._slots else []
        with log.open("ab") as file:
            pilot = subprocess.Popen(  # noqa: S603 - our own interpreter and module
                [sys.executable, "-m", "dashboard.api.pilot", *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=file,
                start_new_session=True,
            )
        assert pilot.stdin is not None  # noqa: S101 - asked for
        with contextlib.suppress(BrokenPipeError), pilot.stdin as said:
            # A URL may hold a password, and everybody sees the arguments of a process.
            said.write(f"{self._store.where}\n".encode())
        return pilot

    def _watched(self, pilot: subprocess.Popen[bytes], label: str) -> int:
        """A pilot's status, once it has ended."""
        self.flying, self.pilot = label, pilot
        self._tell(label, pilot.pid, "running")
        if self._leaving.is_set():
            pilot.send_signal(signal.SIGTERM)
        try:
            status = self._listen(pilot, label)
        except BaseException:
            pilot.kill()
            pilot.wait()
            raise
        finally:
            self.flying, self.pilot = "", None
        self._tell(label, pilot.pid, "ended", status)
        return status

    def _listen(self, pilot: subprocess.Popen[bytes], label: str) -> int:
        """Pass on what a pilot says until it ends; its status."""
        assert pilot.stdout is not None  # noqa: S101 - asked for
        flights: set[int] = set()
        with pilot.stdout as lines:
            for line in lines:
                told = json.loads(line)
                kind, event = told["kind"], told["event"]
                if kind == "sight":
                    flights.add(event["run"])
                    self._see(event["run"], json.dumps(event["sight"]))
                    continue
                key = f"campaign {label}" if kind == "campaign" else f"flight {event['run']}"
                if kind == "run":
                    self._over(event["run"])
                    flights.discard(event["run"])
                elif kind == "flight":
                    flights.add(event["run"])
                self._hub.publish(kind, json.dumps(event), label, "" if kind == "run" else key)
        for run in flights:
            self._over(run)
        return pilot.wait()

    def _over(self, run: int) -> None:
        self._hub.forget(f"flight {run}")
        self._see(run, None)

    def _tell(
        self, label: str, pid: int, state: Literal["running", "ended", "given up"], status: int | None = None
    ) -> None:
        event = ProcessEvent(name=f"pilot {label}", pid=pid, state=state, status=status)
        logger.info("%s %s", event.name, state, extra={"pid": pid, "status": status})
        self._hub.publish("process", event.model_dump_json(), label, f"process {event.name}")
        if state == "ended":
            self._hub.forget(f"process {event.name}")
