"""Lines between processes come whole, whatever the pieces in which they are written, and bounded."""

import os
from collections.abc import Iterator

import pytest

from services.models.base import Strict
from services.system.json_lines import LineReader, LineTooLongError, line_of


class Point(Strict):
    x: int
    name: str = "a\nb"


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    reads, writes = os.pipe()
    yield reads, writes
    os.close(reads)


def test_a_model_is_one_line() -> None:
    line = line_of(Point(x=1))
    assert line.count(b"\n") == 1
    assert Point.model_validate_json(line) == Point(x=1)


def test_lines_come_whole_from_pieces(pipe: tuple[int, int]) -> None:
    reads, writes = pipe
    reader = LineReader(reads)
    for piece, lines in ((b"ab", []), (b"c", []), (b"d\ne", [b"abcd"]), (b"f\n\ng\n", [b"ef", b"", b"g"])):
        os.write(writes, piece)
        assert reader.read() == lines
    os.close(writes)
    assert reader.read() is None


def test_a_line_without_end_is_refused(pipe: tuple[int, int]) -> None:
    reads, writes = pipe
    reader = LineReader(reads, limit_bytes=8)
    os.write(writes, b"12345678")
    assert reader.read() == []
    os.write(writes, b"9")
    with pytest.raises(LineTooLongError):
        reader.read()
    os.close(writes)
