"""The supervisor's end of the control socket (:mod:`deploy.compose.control`)."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from pathlib import Path

from deploy.compose.control import LINE_BYTES, Answer, RefusedError, Request, parse
from deploy.compose.folder import CONTROL
from deploy.compose.view import StackView


async def serve(folder: Path, answer: Callable[[Request], StackView]) -> asyncio.Server:
    """Answer requests on the control socket in ``folder``, which is private."""

    async def converse(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while line := await reader.readline():
                writer.write(_answer(line, answer).model_dump_json().encode() + b"\n")
                await writer.drain()
        except (ConnectionError, ValueError):  # gone, or a line without end
            pass
        finally:
            writer.close()

    path = folder / CONTROL
    server = await asyncio.start_unix_server(converse, path, limit=LINE_BYTES)
    os.chmod(path, 0o600)  # noqa: PTH101 - the socket's own mode
    return server


def _answer(line: bytes, answer: Callable[[Request], StackView]) -> Answer:
    try:
        return Answer(view=answer(parse(line)))
    except RefusedError as error:
        return Answer(error=str(error))
