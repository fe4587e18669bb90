"""MAVLink 2: the few messages that simulator and autopilot exchange, as bytes.

Message definitions are facts of the public ``common.xml``; the checksum's seed of each message (CRC_EXTRA) is
computed from its definition as https://mavlink.io/en/guide/serialization.html has it.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import NamedTuple

BEGIN = 0xFD
_HEAD = struct.Struct("<BBBBBBBHB")  # the message's number has three bytes, low ones first
_CODES = {
    "uint64_t": "Q",
    "uint32_t": "I",
    "int32_t": "i",
    "float": "f",
    "uint16_t": "H",
    "int16_t": "h",
    "uint8_t": "B",
}


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        value = byte
        for _ in range(8):
            value = value >> 1 ^ (0x8408 if value & 1 else 0)
        table.append(value)
    return tuple(table)


_TABLE = _crc_table()


def checksum(data: bytes, start: int = 0xFFFF) -> int:
    """The checksum of MAVLink, CRC-16/MCRF4XX, of ``data`` or of its continuation from ``start``."""
    value = start
    for byte in data:
        value = value >> 8 ^ _TABLE[(value ^ byte) & 0xFF]
    return value


@dataclass(frozen=True, slots=True)
class MessageType:
    """One message: its number, name and fields ``type name`` or ``type[n] name`` in declared order."""

    number: int
    name: str
    declared: tuple[str, ...]
    names: tuple[str, ...] = field(init=False)
    layout: struct.Struct = field(init=False)
    crc_extra: int = field(init=False)

    def __post_init__(self) -> None:
        """Order the fields as they are sent: larger types first, equal ones as declared."""
        parsed = [_parsed(one) for one in self.declared]
        sent = sorted(parsed, key=lambda one: -struct.calcsize("<" + _CODES[one.type]))
        seed = checksum(f"{self.name} ".encode())
        for one in sent:
            seed = checksum(f"{one.type} {one.name} ".encode(), seed)
            seed = checksum(bytes([one.length]), seed) if one.length else seed
        set_ = object.__setattr__
        set_(self, "names", tuple(one.name for one in sent for _ in range(max(one.length, 1))))
        set_(
            self,
            "layout",
            struct.Struct("<" + "".join(_CODES[one.type] * max(one.length, 1) for one in sent)),
        )
        set_(self, "crc_extra", seed & 0xFF ^ seed >> 8)

    def packed(self, values: Mapping[str, float | tuple[float, ...]]) -> bytes:
        """The payload: fields that are not given are zero; trailing zeros are cut, as MAVLink 2 has it."""
        flat: list[float] = []
        for name in dict.fromkeys(self.names):
            count = self.names.count(name)
            given = values.get(name, 0)
            flat += given if isinstance(given, tuple) else [given] * count
        return self.layout.pack(*flat).rstrip(b"\0") or b"\0"

    def unpacked(self, payload: bytes) -> dict[str, tuple[float, ...]]:
        """The fields of a payload, each as a tuple; what was cut is zero, what is beyond is an extension."""
        size = self.layout.size
        numbers = self.layout.unpack(payload[:size].ljust(size, b"\0"))
        found: dict[str, tuple[float, ...]] = {}
        for name, number in zip(self.names, numbers, strict=True):
            found[name] = (*found.get(name, ()), number)
        return found


class _Field(NamedTuple):
    type: str
    length: int
    name: str


def _parsed(declared: str) -> _Field:
    kind, name = declared.split()
    kind, _, count = kind.partition("[")
    return _Field(kind, int(count.removesuffix("]") or 0), name)


HEARTBEAT = MessageType(
    0,
    "HEARTBEAT",
    (
        "uint8_t type",
        "uint8_t autopilot",
        "uint8_t base_mode",
        "uint32_t custom_mode",
        "uint8_t system_status",
        "uint8_t mavlink_version",
    ),
)
COMMAND_LONG = MessageType(
    76,
    "COMMAND_LONG",
    (
        "uint8_t target_system",
        "uint8_t target_component",
        "uint16_t command",
        "uint8_t confirmation",
        *(f"float param{n}" for n in range(1, 8)),
    ),
)
SET_POSITION_TARGET_LOCAL_NED = MessageType(
    84,
    "SET_POSITION_TARGET_LOCAL_NED",
    (
        "uint32_t time_boot_ms",
        "uint8_t target_system",
        "uint8_t target_component",
        "uint8_t coordinate_frame",
        "uint16_t type_mask",
        *(
            f"float {name}"
            for name in ("x", "y", "z", "vx", "vy", "vz", "afx", "afy", "afz", "yaw", "yaw_rate")
        ),
    ),
)
HIL_ACTUATOR_CONTROLS = MessageType(
    93,
    "HIL_ACTUATOR_CONTROLS",
    ("uint64_t time_usec", "float[16] controls", "uint8_t mode", "uint64_t flags"),
)
HIL_SENSOR = MessageType(
    107,
    "HIL_SENSOR",
    (
        "uint64_t time_usec",
        *(f"float {axis}{what}" for what in ("acc", "gyro", "mag") for axis in "xyz"),
        "float abs_pressure",
        "float diff_pressure",
        "float pressure_alt",
        "float temperature",
        "uint32_t fields_updated",
    ),
)
HIL_GPS = MessageType(
    113,
    "HIL_GPS",
    (
        "uint64_t time_usec",
        "uint8_t fix_type",
        "int32_t lat",
        "int32_t lon",
        "int32_t alt",
        "uint16_t eph",
        "uint16_t epv",
        "uint16_t vel",
        "int16_t vn",
        "int16_t ve",
        "int16_t vd",
        "uint16_t cog",
        "uint8_t satellites_visible",
    ),
)
HIL_STATE_QUATERNION = MessageType(
    115,
    "HIL_STATE_QUATERNION",
    (
        "uint64_t time_usec",
        "float[4] attitude_quaternion",
        "float rollspeed",
        "float pitchspeed",
        "float yawspeed",
        "int32_t lat",
        "int32_t lon",
        "int32_t alt",
        "int16_t vx",
        "int16_t vy",
        "int16_t vz",
        "uint16_t ind_airspeed",
        "uint16_t true_airspeed",
        "int16_t xacc",
        "int16_t yacc",
        "int16_t zacc",
    ),
)

MESSAGES: Mapping[int, MessageType] = MappingProxyType(
    {
        one.number: one
        for one in (
            HEARTBEAT,
            COMMAND_LONG,
            SET_POSITION_TARGET_LOCAL_NED,
            HIL_ACTUATOR_CONTROLS,
            HIL_SENSOR,
            HIL_GPS,
            HIL_STATE_QUATERNION,
        )
    }
)
"""Those that we know; others are skipped."""


class Sender:
    """Numbers and frames the messages of one component."""

    def __init__(self, system: int, component: int) -> None:
        self._system, self._component, self._sequence = system, component, 0

    def frame(self, message: MessageType, **values: float | tuple[float, ...]) -> bytes:
        """The bytes by which a message is sent: head, payload and checksum."""
        payload = message.packed(values)
        low, high = message.number & 0xFFFF, message.number >> 16
        head = _HEAD.pack(BEGIN, len(payload), 0, 0, self._sequence, self._system, self._component, low, high)
        self._sequence = (self._sequence + 1) % 256
        crc = checksum(bytes([message.crc_extra]), checksum(head[1:] + payload))
        return head + payload + struct.pack("<H", crc)


class Receiver:
    """Finds messages in a stream of bytes; what is none, or unknown, is skipped and counted."""

    def __init__(self) -> None:
        self._rest = b""
        self.skipped = 0

    def receive(self, data: bytes) -> Iterator[tuple[MessageType, dict[str, tuple[float, ...]]]]:
        """The messages that ``data`` completes."""
        self._rest += data
        while True:
            begin = self._rest.find(BEGIN)
            if begin < 0:
                self._rest = b""
                return
            self._rest = self._rest[begin:]
            if len(self._rest) < _HEAD.size:
                return
            _, length, incompatible, *_, low, high = _HEAD.unpack_from(self._rest)
            size = _HEAD.size + length + 2 + (13 if incompatible & 1 else 0)  # a signature follows
            if len(self._rest) < size:
                return
            known = MESSAGES.get(low | high << 16)
            payload = self._rest[_HEAD.size : _HEAD.size + length]
            if known is not None and self._is_sound(known, length):
                self._rest = self._rest[size:]
                yield known, known.unpacked(payload)
            else:
                # One that is unknown cannot be told from noise: its checksum's seed is not known either.
                self.skipped += 1
                self._rest = self._rest[size if known is None else 1 :]

    def _is_sound(self, known: MessageType, length: int) -> bool:
        end = _HEAD.size + length
        crc = checksum(bytes([known.crc_extra]), checksum(self._rest[1:end]))
        return self._rest[end : end + 2] == struct.pack("<H", crc)
