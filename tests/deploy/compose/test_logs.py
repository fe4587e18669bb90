"""Logs: nothing is lost that is not counted, and no log grows without bound."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deploy.compose.logs import LINE_BYTES, Log, LogFollower, rotated, tail
from deploy.compose.stack_file import LogLimits

PLENTY = LogLimits(bytes_per_s=100_000_000)


def lines(path: Path) -> list[str]:
    return [line.partition(" ")[2] for line in path.read_text().splitlines()]


def test_lines_are_whole_however_they_come(tmp_path: Path) -> None:
    log = Log(tmp_path / "x.log", PLENTY)
    for part in (b"on", b"e\ntw", b"o\n\nthr", b"ee"):
        log.take(part)
    log.close()
    assert lines(tmp_path / "x.log") == ["one", "two", "", "three"]


def test_a_line_without_end_is_broken_not_kept_in_memory(tmp_path: Path) -> None:
    log = Log(tmp_path / "x.log", PLENTY)
    for _ in range(10):
        log.take(b"x" * LINE_BYTES)
    log.close()
    assert [len(line) for line in lines(tmp_path / "x.log")] == [LINE_BYTES] * 10


def test_the_oldest_file_goes(tmp_path: Path) -> None:
    log = Log(tmp_path / "x.log", LogLimits(file_bytes=1024, files=3, bytes_per_s=100_000_000))
    for number in range(1000):
        log.take(f"{number}\n".encode())
    log.close()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["x.log", "x.log.1", "x.log.2"]
    kept = [*lines(rotated(log.path, 2)), *lines(rotated(log.path, 1)), *lines(log.path)]
    assert kept == [str(number) for number in range(1000 - len(kept), 1000)]
    assert all(file.stat().st_size <= 1024 for file in tmp_path.iterdir())


def test_a_full_disk_is_counted_and_survived() -> None:
    log = Log(Path("/dev/full"), PLENTY)
    log.take(b"one\ntwo\n")
    log.close()
    assert log.lost == 2


@given(st.lists(st.lists(st.integers(0, 400), max_size=10), max_size=10))
def test_kept_and_lost_are_all_that_came(
    tmp_path_factory: pytest.TempPathFactory, writes: list[list[int]]
) -> None:
    folder = tmp_path_factory.mktemp("log")
    log = Log(folder / "x.log", LogLimits(bytes_per_s=1024))
    for sizes in writes:
        log.take(b"".join(b"x" * size + b"\n" for size in sizes))
    log.close()
    written = lines(log.path)
    gaps = [int(line.split()[1]) for line in written if line.startswith("zenfi:")]
    assert sum(gaps) == log.lost
    assert len(written) - len(gaps) + log.lost == sum(map(len, writes))


def test_following_goes_on_over_a_rotation(tmp_path: Path) -> None:
    log = Log(tmp_path / "x.log", LogLimits(file_bytes=1024, files=3, bytes_per_s=100_000_000))
    log.take(b"before\n")
    following = LogFollower(log.path)
    seen = []
    for number in range(200):
        log.take(f"{number}\n".encode())
        seen += [line.partition(" ")[2] for line in following.lines()]
    following.close()
    log.close()
    assert seen == [str(number) for number in range(200)]


def test_the_tails_of_several_logs_come_in_the_order_of_time(tmp_path: Path) -> None:
    for name, stamps in (("a", (1, 3, 5)), ("b", (2, 4))):
        text = "".join(f"2026-01-01T00:00:0{stamp}.000Z {name}{stamp}\n" for stamp in stamps)
        (tmp_path / name).write_text(text)
    there = {"a": tmp_path / "a", "b": tmp_path / "b", "none": tmp_path / "none"}
    assert [line.split()[1] for _, line in tail(there, 2)] == ["b2", "a3", "b4", "a5"]
