"""A tape never holds a flight up: what the disk is too slow for is counted, a full disk is told."""

import os
import threading
from pathlib import Path

import pytest

from dashboard.analysis.recordings_reader import open_run
from deploy.errors import DisturbedFlightError
from deploy.recording import mcap_recorder
from deploy.recording.mcap_recorder import McapRecorder
from deploy.recording.ordering import SentMessage
from services.bus.horizon import Stamped
from services.models.mission import MissionSpec
from tests.conftest import wait_until
from tests.dashboard.campaigns.store.test_store import outcome

SPEC = MissionSpec(seed=7)


def batch(number: int, size: int = 1000) -> list[SentMessage]:
    return [SentMessage("depth", Stamped(number, 40 * number, os.urandom(size)))]


def test_a_disk_that_is_too_slow_costs_messages_and_they_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mcap_recorder, "WAITING_BYTES", 10_000)
    fifo = tmp_path / "slow.mcap"
    os.mkfifo(fifo)  # nobody reads: whoever opens it waits
    with McapRecorder(fifo, SPEC) as slow:
        for number in range(100):
            slow.offer(batch(number))
        reader = threading.Thread(target=fifo.read_bytes)
        reader.start()
        report = slow.finish(outcome())
        reader.join()
    assert report.dropped == 90
    assert report.problem  # a pipe is no place for a file


def test_a_full_disk_is_told_and_nothing_is_raised() -> None:
    with McapRecorder(Path("/dev/full"), SPEC) as full:
        full.offer(batch(0, 3_000_000))
        report = full.finish(outcome())
    assert report.problem == "No space left on device"


def test_dropped_messages_leave_a_gap_in_the_sequence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "gap.mcap"
    with McapRecorder(path, SPEC) as one:
        one.offer(batch(0))
        monkeypatch.setattr(mcap_recorder, "WAITING_BYTES", 0)
        one.offer(batch(1))
        monkeypatch.setattr(mcap_recorder, "WAITING_BYTES", 10**9)
        one.offer(batch(2))
        report = one.finish(outcome())
    assert (report.messages, report.dropped, report.problem) == (2, 1, "")
    assert [message.seq for message in open_run(path).messages["depth"]] == [0, 2]
    assert open_run(path).about["dropped messages"] == "1"


def test_a_recording_that_is_removed_meanwhile_is_told_as_a_disturbance(tmp_path: Path) -> None:
    path = tmp_path / "gone.mcap"
    with McapRecorder(path, SPEC) as one:
        one.offer(batch(0))
        wait_until(path.exists)
        path.unlink()
        with pytest.raises(DisturbedFlightError, match=r"gone\.mcap: the file was removed"):
            one.finish(outcome())
