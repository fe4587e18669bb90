"""Starts the process of each campaign that is to be flown, and restarts it when it dies.

There are two lanes, each with one campaign process at a time: campaigns, and single flights, which do not
wait for campaigns. The desired states are in the store alone, so a new life of the service goes on where
the last one was killed.
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
from datetime import UTC, datetime
from typing import Any, Literal

from dashboard.api.processes.event_bus import EventBus
from dashboard.api.processes.events import ProcessEvent
from dashboard.campaigns import commands
from dashboard.campaigns.spec import CampaignSpec, cells
from dashboard.campaigns.store.listing import line
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.campaigns.store.store import BusyError, Store
from deploy.errors import BadSpecError
from deploy.recording.snapshot import FlightSnapshot
from services.models.base import Strict

LOOK_S = 2.0
"""Interval at which the store is read for campaigns to fly; :meth:`CampaignRunner.notify` shortens it."""

FAILURES = 5
"""Failures in a row, of its process or its set-up, after which a campaign waits until somebody resumes it."""

GRACE_S = 15.0
"""Time that a campaign process has to store its state after SIGTERM."""

logger = logging.getLogger("zenfi.runner")


class FlownRun(Strict):
    """A flight that has come to a result, and when."""

    campaign: str
    run: int
    at: str


class LaneState(Strict):
    """How a lane is: whether its thread lives, what it flies, how often in a row it could not."""

    name: str
    alive: bool
    flying: str
    failures: int


def is_flight(spec: CampaignSpec) -> bool:
    """Whether a campaign is a single flight."""
    return len(cells(spec)) * spec.runs == 1


class CampaignRunner:
    """Starts and ends the campaign processes; ``stop`` pauses their campaigns."""

    def __init__(self, store: Store, event_bus: EventBus, slots: int | None) -> None:
        self._event_bus = event_bus
        self.given_up: dict[str, str] = {}
        self._sights: dict[int, str] = {}
        self._lanes = [
            _Lane("campaigns", self, store, event_bus, lambda spec: not is_flight(spec), slots),
            _Lane("flights", self, store, event_bus, is_flight, 1),
        ]

    def start(self) -> None:
        """Start the lanes, which fly the campaigns in the store."""
        for lane in self._lanes:
            lane.thread.start()

    def notify(self, label: str) -> None:
        """Have the store read now, as the desired state of a campaign has changed."""
        self.given_up.pop(label, None)
        for lane in self._lanes:
            lane.notified.set()

    def sight(self, run: int) -> FlightSnapshot | None:
        """What a run's flight sees, None if it is not under way or has seen nothing yet."""
        told = self._sights.get(run)
        return FlightSnapshot.model_validate_json(told) if told is not None else None

    def see(self, run: int, told: str | None) -> None:
        """Keep what a flight sees, as JSON; None: it is over."""
        if told is None:
            self._sights.pop(run, None)
        else:
            self._sights[run] = told

    def stop(self) -> None:
        """Have the campaign processes end, and wait for them."""
        for lane in self._lanes:
            lane.leave()
        for lane in self._lanes:
            lane.end(GRACE_S)

    @property
    def working(self) -> bool:
        """Whether the threads of both lanes are alive."""
        return all(lane.thread.is_alive() for lane in self._lanes)

    @property
    def lanes(self) -> list[LaneState]:
        """The state of both lanes: what they fly, and whether their threads live."""
        return [lane.state for lane in self._lanes]

    @property
    def last_flight(self) -> FlownRun | None:
        """The newest flight that came to a result, in this life of the service."""
        flown = [lane.last_flight for lane in self._lanes if lane.last_flight is not None]
        return max(flown, key=lambda one: one.at, default=None)

    @property
    def processes(self) -> dict[str, int]:
        """The pid of the process of each campaign that is flown."""
        return {lane.flying: lane.process.pid for lane in self._lanes if lane.process is not None}


class _Lane:
    def __init__(
        self,
        name: str,
        runner: CampaignRunner,
        store: Store,
        event_bus: EventBus,
        mine: Callable[[CampaignSpec], bool],
        slots: int | None,
    ) -> None:
        self._store, self._event_bus, self._mine = store, event_bus, mine
        self._given_up, self._see = runner.given_up, runner.see
        self._slots = slots
        self._failures = 0
        self._leaving = threading.Event()
        self.notified = threading.Event()
        self.flying = ""
        self.last_flight: FlownRun | None = None
        self.process: subprocess.Popen[bytes] | None = None
        # The process dies with the thread that started it: this one, which lives as long as the service.
        self.thread = threading.Thread(target=self._work, name=f"lane-{name}", daemon=True)

    @property
    def state(self) -> LaneState:
        """The state of the lane: what it flies, and whether its thread lives."""
        name, alive = self.thread.name.removeprefix("lane-"), self.thread.is_alive()
        return LaneState(name=name, alive=alive, flying=self.flying, failures=self._failures)

    def leave(self) -> None:
        """Start nothing more; have the process pause its campaign."""
        self._leaving.set()
        self.notified.set()
        process = self.process
        if process is not None:
            process.send_signal(signal.SIGTERM)

    def end(self, grace_s: float) -> None:
        """Wait for the process; kill it if it does not end."""
        self.thread.join(grace_s)
        process = self.process
        if process is not None:
            process.kill()
        self.thread.join()

    def _work(self) -> None:
        while not self._leaving.is_set():
            self.notified.clear()
            try:
                campaign = self._next()
                if campaign is not None:
                    self._fly(campaign)
            except Exception:  # the service outlives a bad moment of the store
                logger.exception("the store does not answer")
                campaign = None
            if campaign is None:
                self.notified.wait(LOOK_S)

    def _next(self) -> CampaignEntry | None:
        wanted = self._store.to_be_flown()
        mine = (one for one in wanted if self._mine(one.spec) and one.label not in self._given_up)
        return next(mine, None)

    def _fly(self, campaign: CampaignEntry) -> None:
        before = self._store.progress(campaign)["done"]
        try:
            process = self._started(campaign)
        except (OSError, BadSpecError) as error:
            self._not_begun(campaign, str(error))
            return
        status = self._watched(process, campaign.label)
        if status in (0, 130) or self._leaving.is_set():
            self._failures = 0
            return
        self._failures = 1 if self._store.progress(campaign)["done"] > before else self._failures + 1
        if self._failures >= FAILURES:
            self._failures = 0
            self._given_up[campaign.label] = f"its process died {FAILURES} times: see its log"
            self._tell(campaign.label, 0, "given up")
        else:
            self._leaving.wait(2.0**self._failures - 1)

    def _not_begun(self, campaign: CampaignEntry, why: str) -> None:
        """Try again in a while, but not for ever: others wait behind it."""
        logger.warning("%s cannot be set up: %s", campaign.label, why)
        self._failures += 1
        if self._failures < FAILURES:
            self._leaving.wait(2.0**self._failures - 1)
            return
        self._failures = 0
        try:
            commands.give_up(self._store, campaign, f"it cannot be set up: {why}")
        except BusyError as error:
            self._given_up[campaign.label] = str(error)
        stands = line(self._store, self._store.find(campaign.label))
        self._event_bus.publish(
            "campaign", stands.model_dump_json(), campaign.label, f"campaign {campaign.label}"
        )

    def _started(self, campaign: CampaignEntry) -> subprocess.Popen[bytes]:
        """Start the process of a campaign, with its log among the artefacts.

        :raises OSError, BadSpecError: if it has no folder, or no process can be started.
        """
        log = self._store.artefacts(campaign) / "campaign.log"
        arguments = [str(os.getpid()), campaign.label]
        arguments += [str(self._slots)] if self._slots else []
        with log.open("ab") as file:
            process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
                [sys.executable, "-P", "-m", "dashboard.api.processes.campaign_process", *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=file,
                start_new_session=True,
            )
        assert process.stdin is not None  # noqa: S101 - asked for
        with contextlib.suppress(BrokenPipeError), process.stdin as said:
            # A URL may hold a password, and everybody sees the arguments of a process.
            said.write(f"{self._store.where}\n".encode())
        return process

    def _watched(self, process: subprocess.Popen[bytes], label: str) -> int:
        """Forward the events of a process; its exit status, once it has ended."""
        self.flying, self.process = label, process
        self._tell(label, process.pid, "running")
        if self._leaving.is_set():
            process.send_signal(signal.SIGTERM)
        try:
            status = self._listen(process, label)
        except BaseException:
            process.kill()
            process.wait()
            raise
        finally:
            self.flying, self.process = "", None
        self._tell(label, process.pid, "ended", status)
        return status

    def _listen(self, process: subprocess.Popen[bytes], label: str) -> int:
        """Publish the messages of a process until it ends; its exit status."""
        assert process.stdout is not None  # noqa: S101 - asked for
        flights: set[int] = set()
        with process.stdout as lines:
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
                    self._note_flight(label, event)
                elif kind == "flight":
                    flights.add(event["run"])
                self._event_bus.publish(kind, json.dumps(event), label, "" if kind == "run" else key)
        for run in flights:
            self._over(run)
        return process.wait()

    def _note_flight(self, label: str, event: dict[str, Any]) -> None:
        if event["result"] is not None:
            now = datetime.now(UTC).isoformat(timespec="milliseconds")
            self.last_flight = FlownRun(campaign=label, run=event["run"], at=now)

    def _over(self, run: int) -> None:
        self._event_bus.forget(f"flight {run}")
        self._see(run, None)

    def _tell(
        self, label: str, pid: int, state: Literal["running", "ended", "given up"], status: int | None = None
    ) -> None:
        event = ProcessEvent(name=f"campaign {label}", pid=pid, state=state, status=status)
        logger.info("%s %s", event.name, state, extra={"pid": pid, "status": status})
        self._event_bus.publish("process", event.model_dump_json(), label, f"process {event.name}")
        if state == "ended":
            self._event_bus.forget(f"process {event.name}")
