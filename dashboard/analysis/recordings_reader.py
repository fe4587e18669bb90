"""Recordings read back: the messages of any topic, and tables of them.

>>> run = open_run("run-7.mcap")
>>> run.table("odometry")["pose.pose.position.x"]

Reads any MCAP file of ROS 2 messages by the schemas in it. One whose flight was killed has no index and no
end: of it every complete chunk is read.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Chunk, Footer, Message, Metadata, Schema
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk
from pydantic import ValidationError
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from dashboard.analysis.table import Table, column
from deploy.errors import BadSpecError, one_line
from deploy.recording.mcap_file import METADATA
from deploy.recording.propagation import Messages
from services.bus.fields import flat
from services.bus.horizon import Stamped
from services.bus.topics import RECORDED
from services.models.mission import MissionSpec
from services.models.outcome import InjectionRecord

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LARGEST_RECORD = 2**26


@dataclass
class FlightRecording:
    """One flight as it was recorded; topics without the leading slash."""

    path: Path
    complete: bool = False
    about: dict[str, str] = field(default_factory=dict)
    types: dict[str, str] = field(default_factory=dict)
    messages: dict[str, list[Stamped]] = field(default_factory=dict)
    _store: Typestore = field(default_factory=lambda: get_typestore(Stores.EMPTY))

    def decoded(self, topic: str) -> Iterator[Any]:
        """The messages of a topic, one after the other.

        :raises BadSpecError: if it was not recorded, or a message of it makes no sense.
        """
        name = topic.removeprefix("/")
        if name not in self.messages:
            problem = f"{self.path}: no topic {name!r}; it has {', '.join(sorted(self.messages)) or 'none'}"
            raise BadSpecError(problem)
        for message in self.messages[name]:
            try:
                yield self._store.deserialize_cdr(message.payload, self.types[name])
            except (SerdeError, ValueError, IndexError) as error:
                problem = f"{self.path}: {name}: message {message.seq} makes no sense: {error}"
                raise BadSpecError(problem) from error

    def table(self, topic: str) -> Table:
        """The messages of a topic, a row each: ``ready_ns`` and ``seq``, then the message's fields.

        In a list of messages a message is a dictionary of its fields.

        :raises BadSpecError: if it was not recorded.
        """
        rows = [dict(flat(message)) for message in self.decoded(topic)]
        sent = self.messages[topic.removeprefix("/")]
        table = Table(
            ready_ns=np.array([message.ready_ns for message in sent], dtype=np.int64),
            seq=np.array([message.seq for message in sent], dtype=np.int64),
        )
        for name in rows[0] if rows else ():
            table[name] = column([_plain(row[name]) for row in rows])
        return table

    def plot(self, twin: FlightRecording | None = None) -> Figure:
        """Draw the flown path from above and by height, beside that of its golden twin if there is one.

        :raises BadSpecError: if matplotlib is not installed, or the file does not say what was flown.
        """
        from dashboard.analysis import plots  # noqa: PLC0415 - which reads recordings

        return plots.path(self, twin)

    def plot_propagation(self, twin: FlightRecording) -> Figure:
        """Draw how far each topic strayed from the golden twin.

        :raises BadSpecError: if ``twin`` is not its golden twin, or matplotlib is not installed.
        """
        from dashboard.analysis import plots  # noqa: PLC0415 - which reads recordings

        return plots.growth(self, twin)

    @property
    def flight(self) -> Messages:
        """The messages of the topics that make up a flight; of one without messages an empty list."""
        return {topic.name: self.messages.get(topic.name, []) for topic in RECORDED}

    @property
    def spec(self) -> MissionSpec:
        """The specification of the recorded mission.

        :raises BadSpecError: if the file does not say it.
        """
        try:
            return MissionSpec.model_validate_json(self.about.get("spec", ""))
        except ValidationError as error:
            message = f"{self.path}: not a flight of ours: {one_line(error)}"
            raise BadSpecError(message) from error

    @property
    def injection(self) -> InjectionRecord | None:
        """What the injector did, as far as that repeats; None if no fault was injected."""
        told = (
            [message.record for message in self.decoded("injection")] if "injection" in self.messages else []
        )
        return InjectionRecord.model_validate_json(told[0]) if told else None


def open_run(path: str | Path) -> FlightRecording:
    """Read a recording (MCAP) of a run.

    :raises BadSpecError: if there is none, it is no MCAP file, or a complete chunk of it is damaged.
    """
    recording = FlightRecording(Path(path))
    channels: dict[int, str] = {}
    schemas: dict[int, str] = {}
    try:
        with recording.path.open("rb") as stream:
            for record in _records(stream):
                if isinstance(record, Message):
                    sent = Stamped(record.sequence, record.log_time, record.data)
                    recording.messages[channels[record.channel_id]].append(sent)
                elif isinstance(record, Schema):
                    schemas[record.id] = record.name
                    _learn(recording._store, record)
                elif isinstance(record, Channel):
                    topic = record.topic.removeprefix("/")
                    channels[record.id] = topic
                    recording.types[topic] = schemas[record.schema_id]
                    recording.messages.setdefault(topic, [])
                elif isinstance(record, Metadata) and record.name == METADATA:
                    recording.about |= record.metadata
                elif isinstance(record, Footer):
                    recording.complete = True
    except OSError as error:
        message = f"{path}: {error.strerror}"
        raise BadSpecError(message) from error
    except (McapError, CRCValidationError, KeyError, zstandard.ZstdError) as error:
        message = f"{path}: not a recording that can be read: {error}"
        raise BadSpecError(message) from error
    return recording


def _records(stream: BinaryIO) -> Iterator[Any]:
    """All records, of chunks what is in them, up to where the file ends or breaks off."""
    records = iter(StreamReader(stream, emit_chunks=True, record_size_limit=_LARGEST_RECORD).records)
    while True:
        try:
            record = next(records)
        except (StopIteration, EndOfFile, struct.error):
            return
        if not isinstance(record, Chunk):
            yield record
            continue
        try:
            inside = breakup_chunk(record, validate_crc=True)
        except (McapError, CRCValidationError, zstandard.ZstdError, struct.error):
            if not stream.read(1):
                return  # it was being written
            raise
        yield from inside


def _learn(store: Typestore, schema: Schema) -> None:
    known = store.fielddefs
    found = get_types_from_msg(schema.data.decode(), schema.name)
    store.register({name: definition for name, definition in found.items() if name not in known})


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return [_plain(one) for one in value]
    if hasattr(value, "__msgtype__"):
        return {name: _plain(part) for name, part in flat(value)}
    return value
