"""Lines of JSON between our processes: each message is one model on one line."""

from __future__ import annotations

import os

from pydantic import BaseModel

LINE_BYTES = 1 << 28
"""A longer line is none of ours: a process that never ends its line must not fill our memory."""

_CHUNK_BYTES = 1 << 16


class LineTooLongError(ValueError):
    """A process has written more than :data:`LINE_BYTES` without an end of line."""


def line_of(model: BaseModel) -> bytes:
    """A model as one line of JSON, its end included."""
    return model.model_dump_json(by_alias=True).encode() + b"\n"


class LineReader:
    """Reads whole lines from a descriptor as they come; what is not yet a line is kept for the next time."""

    def __init__(self, descriptor: int, limit_bytes: int = LINE_BYTES) -> None:
        self._descriptor = descriptor
        self._limit_bytes = limit_bytes
        self._parts: list[bytes] = []
        self._size = 0

    def read(self) -> list[bytes] | None:
        """Whole lines that have come, without their ends; waits for something to come. None at the end.

        :raises LineTooLongError: if a line exceeds the limit.
        """
        chunk = os.read(self._descriptor, _CHUNK_BYTES)
        if not chunk:
            return None
        first, *lines = chunk.split(b"\n")
        self._parts.append(first)
        self._size += len(first)
        if self._size > self._limit_bytes:
            message = f"a line of more than {self._limit_bytes} bytes"
            raise LineTooLongError(message)
        if not lines:
            return []
        whole = [b"".join(self._parts), *lines[:-1]]
        self._parts, self._size = [lines[-1]], len(lines[-1])
        return whole
