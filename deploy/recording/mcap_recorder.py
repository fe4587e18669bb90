"""The recording of a flight: written by a thread of its own, so that the flight waits for no disk."""

from __future__ import annotations

import queue
import threading
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Protocol

from deploy.errors import DisturbedFlightError, InfrastructureError
from deploy.recording.derived import DERIVED, DerivedMessages
from deploy.recording.mcap_file import McapFile
from deploy.recording.ordering import TYPES, SentMessage, in_order
from services.bus.horizon import Stamped
from services.bus.ros2 import Qos, quality
from services.bus.topics import TOPICS
from services.models.mission import MissionSpec
from services.models.outcome import Outcome, RecordingReport

WAITING_BYTES = 64_000_000
"""Of messages that wait for the disk; what comes beyond is dropped, and counted."""

EVENT = Qos(transient_local=True, depth=1)
"""The quality of service that an event has which is no topic of the bus: an alarm."""

_PACKAGES = ("zenfi", "eclipse-zenoh", "mujoco", "numpy", "numba", "ompl", "pyoctomap", "rosbags", "mcap")


class MessageTap(Protocol):
    """Receives the messages of a flight in their final order. Must not wait."""

    def offer(self, batch: Sequence[SentMessage]) -> None:
        """Take the messages that became final since the last call."""


class McapRecorder:
    """Records one flight to a file. ``about`` is what the file is to say of it beside its specification."""

    def __init__(self, path: Path, spec: MissionSpec, about: Mapping[str, str] | None = None) -> None:
        self._path = path
        self._about = {**_about(spec), **(about or {})}
        self._derived = DerivedMessages(spec)
        self._queue: queue.SimpleQueue[Sequence[SentMessage] | Outcome | None] = queue.SimpleQueue()
        self._offered = self._taken = 0  # bytes, each counted by one thread alone
        self._written = self._dropped = 0
        self._problem: Exception | None = None
        self._thread = threading.Thread(target=self._write, name="recording", daemon=True)

    def __enter__(self) -> McapRecorder:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._queue.put(None)
        self._thread.join()

    def offer(self, batch: Sequence[SentMessage]) -> None:
        """Queue messages for the writer; drops them if the queue is full. Never waits."""
        size = _size(batch)
        if self._offered - self._taken + size > WAITING_BYTES:
            self._dropped += len(batch)
            return
        self._offered += size
        self._queue.put(batch)

    def copy(self, messages: Mapping[str, Sequence[Stamped]]) -> None:
        """Queue all messages of a flight that is in memory anyway."""
        sent = (SentMessage(topic, message) for topic, kept in messages.items() for message in kept)
        self._queue.put(in_order(sent))

    def finish(self, outcome: Outcome) -> RecordingReport:
        """Write the outcome and close the file; then it can be opened.

        :raises DisturbedFlightError: if somebody has removed the file.
        :raises InfrastructureError: if the infrastructure failed. A full disk is stated in the report.
        """
        self._queue.put(outcome)
        self._thread.join()
        problem = ""
        if isinstance(self._problem, OSError):
            problem = self._problem.strerror or str(self._problem)
        elif self._problem is not None:
            message = f"recording {self._path}: {self._problem!r}"
            raise InfrastructureError(message) from self._problem
        if not problem and not self._path.exists():
            message = f"recording {self._path}: the file was removed while it was written"
            raise DisturbedFlightError(message)
        size = self._path.stat().st_size if self._path.exists() else 0
        return RecordingReport(
            messages=self._written, dropped=self._dropped, size_bytes=size, problem=problem
        )

    def _write(self) -> None:
        try:
            with self._path.open("wb") as stream:
                file = McapFile(stream, self._about)
                while (item := self._queue.get()) is not None:
                    if isinstance(item, Outcome):
                        file.finish(_end(item, self._dropped))
                        return
                    for sent in item:
                        self._put(file, sent)
                    file.flush()
                    self._taken += _size(item)
        except Exception as error:  # noqa: BLE001 - raised in finish()
            self._problem = error

    def _put(self, file: McapFile, sent: SentMessage) -> None:
        declared = TOPICS.get(sent.topic)
        offered = EVENT if declared is None else quality(declared)
        file.write(sent.topic, TYPES[sent.topic], offered, sent.message)
        self._written += 1
        for made in self._derived.of(sent):
            file.write(made.topic, *DERIVED[made.topic], made.message)


def _size(batch: Sequence[SentMessage]) -> int:
    return sum(len(sent.message.payload) for sent in batch)


def _about(spec: MissionSpec) -> dict[str, str]:
    fault = spec.fault.model_dump_json() if spec.fault is not None else ""
    versions = {f"version {package}": version(package) for package in _PACKAGES}
    return {"seed": str(spec.seed), "fault": fault, "spec": spec.model_dump_json(), **versions}


def _end(outcome: Outcome, dropped: int) -> dict[str, str]:
    return {"result": outcome.result, "digest": outcome.digest, "dropped messages": str(dropped)}
