"""MAVLink 2 as others have it: seeds and frames of its documentation, and streams that are damaged."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.autopilot.mavlink import HEARTBEAT, HIL_SENSOR, MESSAGES, Receiver, Sender, checksum

PUBLISHED = {0: 50, 76: 152, 84: 143, 93: 47, 107: 108, 113: 124, 115: 4}
"""CRC_EXTRA of each message, from https://mavlink.io/en/messages/common.html."""


def test_the_checksum_is_the_published_one() -> None:
    assert checksum(b"123456789") == 0x6F91  # CRC-16/MCRF4XX, the catalogue's check value


def test_seeds_follow_from_the_definitions() -> None:
    assert {number: one.crc_extra for number, one in MESSAGES.items()} == PUBLISHED


def test_a_heartbeat_is_what_every_ground_station_sends() -> None:
    """Of a ground station, system 255 component 190: type GCS, no autopilot, state active, version 3."""
    sent = Sender(255, 190).frame(
        HEARTBEAT, type=6, autopilot=8, base_mode=192, system_status=4, mavlink_version=3
    )
    assert sent[:10].hex() == "fd0900" + "0000" + "ffbe" + "000000"
    assert sent[10:19].hex() == "00000000" + "0608c00403"
    assert len(sent) == 21


@given(st.binary(max_size=40), st.integers(1, 60))
def test_noise_between_messages_loses_none(noise: bytes, cut: int) -> None:
    sender, receiver = Sender(1, 1), Receiver()
    frames = [sender.frame(HIL_SENSOR, time_usec=number, xacc=1.5, temperature=25.0) for number in range(4)]
    stream = b"".join(noise.replace(b"\xfd", b"") + frame for frame in frames)
    heard = [one for at in range(0, len(stream), cut) for one in receiver.receive(stream[at : at + cut])]
    assert [values["time_usec"] for kind, values in heard if kind is HIL_SENSOR] == [(0,), (1,), (2,), (3,)]
    assert all(values["xacc"] == pytest.approx((1.5,)) for _, values in heard)


def test_a_damaged_message_is_skipped_and_counted() -> None:
    sender, receiver = Sender(1, 1), Receiver()
    good, bad = sender.frame(HIL_SENSOR, time_usec=1), bytearray(sender.frame(HIL_SENSOR, time_usec=2))
    bad[12] ^= 1
    heard = list(receiver.receive(bytes(bad) + good))
    assert [values["time_usec"] for _, values in heard] == [(1,)]
    assert receiver.skipped
