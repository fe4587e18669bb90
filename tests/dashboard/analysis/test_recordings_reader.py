"""Recordings are read back as tables, ours and others'; what is no recording is refused by name."""

from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer
from mcap_ros2.writer import Writer as Ros2Writer

from dashboard.analysis.recordings_reader import open_run
from deploy.errors import BadSpecError
from services.bus.topics import TICK_NS
from services.models.outcome import QoF
from tests.dashboard.recorded import flights

__all__ = ["flights"]


def test_a_topic_is_a_table_of_columns(flights: dict[str, Path]) -> None:
    run = open_run(flights["golden"])
    table = run.table("/odometry")
    count = len(run.messages["odometry"])
    assert table["ready_ns"].dtype == np.int64
    assert list(table["ready_ns"]) == [TICK_NS * tick for tick in range(count)]
    assert list(table["seq"]) == list(range(count))
    assert table["pose.pose.position.x"].shape == (count,)
    assert table["pose.covariance"].shape == (count, 36)
    assert table["child_frame_id"][0] == "base_link"
    assert not [name for name in table if "__" in name]
    flown = np.stack([table[f"pose.pose.position.{axis}"] for axis in "xyz"])
    qof = QoF.model_validate_json(run.table("mission")["qof"][-1])
    assert np.linalg.norm(np.diff(flown), axis=0).sum() == pytest.approx(qof.distance_m, rel=0.01)
    imu = run.table("imu")
    assert "time_ns" in imu
    assert len(imu["ready_ns"]) == len(run.messages["imu"])


def test_a_table_goes_to_arrow(flights: dict[str, Path]) -> None:
    run = open_run(flights["golden"])
    for topic in run.messages:
        arrow = run.table(topic).arrow()
        assert arrow.num_rows == len(run.messages[topic])
    assert run.table("tf").arrow()["transforms"][0].as_py()[0]["child_frame_id"] == "base_link"


def test_recordings_of_others_are_read_by_their_own_schemas(tmp_path: Path) -> None:
    path = tmp_path / "other.mcap"
    with path.open("wb") as stream:
        writer = Ros2Writer(stream)
        schema = writer.register_msgdef("their_msgs/msg/Pair", "float64 left\nfloat64[] right\nstring name")
        for number in range(3):
            message = {"left": number / 2, "right": [1.0] * number, "name": f"n{number}"}
            writer.write_message("/pairs", schema, message, log_time=number, publish_time=number)
        writer.finish()  # type: ignore[no-untyped-call]
    run = open_run(path)
    table = run.table("pairs")
    assert list(table["left"]) == [0.0, 0.5, 1.0]
    assert [list(one) for one in table["right"]] == [[], [1.0], [1.0, 1.0]]
    assert list(table["name"]) == ["n0", "n1", "n2"]
    with pytest.raises(BadSpecError, match="not a flight of ours"):
        _ = run.spec


def test_what_is_no_recording_is_refused_by_name(tmp_path: Path, flights: dict[str, Path]) -> None:
    path = tmp_path / "x.mcap"
    with pytest.raises(BadSpecError, match=r"x\.mcap: No such file"):
        open_run(path)
    path.write_bytes(b"not MCAP at all")
    with pytest.raises(BadSpecError, match=r"x\.mcap: not a recording"):
        open_run(path)
    damaged = bytearray(flights["golden"].read_bytes())
    damaged[len(damaged) // 3] ^= 0x10
    path.write_bytes(damaged)
    with pytest.raises(BadSpecError, match=r"x\.mcap: not a recording"):
        open_run(path)
    with pytest.raises(BadSpecError, match=r"no topic 'odo'; it has .*odometry"):
        open_run(flights["golden"]).table("odo")


def test_a_recording_without_messages_is_one(tmp_path: Path) -> None:
    path = tmp_path / "empty.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.finish()  # type: ignore[no-untyped-call]
    run = open_run(path)
    assert run.complete
    assert run.messages == {}
