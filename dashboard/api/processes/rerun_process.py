"""The process that flies a stored run again: to replay it, to record it, or for its detector series.

Run as ``python -m dashboard.api.processes.rerun_process PARENT replay|series|record``.

Reads an outcome from standard input; a flight is a function of its specification. Exit status 2: it cannot
be done, one line on standard error says why.
"""

from __future__ import annotations

import subprocess
import sys
import threading
from contextlib import closing
from os import getpid
from pathlib import Path
from typing import Literal

from dashboard.campaigns.commands import ConflictError
from deploy.errors import BadSpecError, InfrastructureError
from deploy.mission.flight import fly
from deploy.mission.fork_server import ForkServer
from deploy.pairing.replay import replay
from deploy.recording.flight_status import FlightStatus, series
from deploy.recording.mcap_recorder import McapRecorder
from services.models.base import Strict
from services.models.mission import MissionSpec
from services.models.outcome import Outcome, RecordingReport
from services.system.lifeline import die_with_parent

What = Literal["replay", "series", "record"]

_flying = threading.Lock()


class FlightSeries(Strict):
    """Pose and quality of flight of a flight, tick by tick."""

    points: list[FlightStatus]


class RecordedFlight(Strict):
    """What was kept of a run that was flown again: of its flight, and of its golden twin if it has one."""

    flight: RecordingReport
    twin: RecordingReport | None


def rerun(outcome: Outcome, what: What, *paths: str) -> str:
    """Fly ``outcome`` again; the answer as JSON. ``paths`` are where its recording and its twin's are put.

    :raises ConflictError: if another run is being flown again.
    :raises BadSpecError: if it cannot be.
    """
    if not _flying.acquire(blocking=False):
        raise ConflictError("another run is being flown again: one at a time")
    try:
        own = [sys.executable, "-P", "-m", "dashboard.api.processes.rerun_process"]
        done = subprocess.run(  # noqa: S603 - our own interpreter and module
            [*own, str(getpid()), what, *paths],
            input=outcome.model_dump_json(by_alias=True).encode(),
            capture_output=True,
            start_new_session=True,
            check=False,
        )
    finally:
        _flying.release()
    lines = done.stderr.decode(errors="replace").strip().splitlines() or ["it died"]
    if done.returncode == 2:
        raise BadSpecError(lines[-1])
    if done.returncode != 0:
        raise InfrastructureError(lines[-1])
    return done.stdout.decode()


def main() -> None:
    """Read the outcome, fly the run again and write the answer."""
    die_with_parent(int(sys.argv[1]))
    outcome = Outcome.model_validate_json(sys.stdin.read())
    with closing(ForkServer()) as server:
        try:
            if sys.argv[2] == "replay":
                answer: Strict = replay(outcome, server)
            elif sys.argv[2] == "record":
                answer = _record(outcome, server, *map(Path, sys.argv[3:]))
            else:
                messages = fly(outcome.spec, server, keep_messages=True).messages
                answer = FlightSeries(points=series(messages or {}))
        except BadSpecError as error:
            sys.stderr.write(f"{error}\n")
            sys.exit(2)
    sys.stdout.write(answer.model_dump_json())


def _record(outcome: Outcome, server: ForkServer, flight: Path, twin: Path) -> RecordedFlight:
    """Keep both flights; only if they are the run's to the bit.

    :raises BadSpecError: if they are not.
    """
    golden = outcome.golden
    told = None
    if golden is not None:
        told = _kept(outcome.spec.model_copy(update={"fault": None}), golden.digest, server, twin)
    return RecordedFlight(flight=_kept(outcome.spec, outcome.digest, server, flight), twin=told)


def _kept(spec: MissionSpec, digest: str, server: ForkServer, path: Path) -> RecordingReport:
    draft = path.with_suffix(".part")
    try:
        with McapRecorder(draft, spec) as recording:
            flown = fly(spec, server, taps=(recording,)).outcome
            report = recording.finish(flown)
        if report.problem:
            message = f"{path}: {report.problem}"
            raise BadSpecError(message)
        if flown.digest != digest:
            message = (
                "flown again it is another flight: what the nodes' memory follows from has changed since "
                "(a package, a library, what had to be compiled); nothing is kept"
            )
            raise BadSpecError(message)
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)
    return report


if __name__ == "__main__":
    main()
