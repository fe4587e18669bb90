"""People who look at a page from elsewhere: ``python -m tests.bench.page_clients ADDRESS COUNT``.

Each gets the page and speaks the protocol of its socket as NiceGUI's script does, but draws nothing. Prints
``ready`` once all have shaken hands; at the end of standard input, a line of JSON: what they were sent.
Runs at the lowest priority: it stands for machines of their own.
"""

import asyncio
import json
import os
import re
import sys
import uuid
from urllib.parse import urlencode, urlsplit

import httpx
import socketio  # type: ignore[import-untyped]

NAMED = re.compile(r"'client_id': '([0-9a-f-]+)'")
ACK_S = 3.0


class Counted:
    """JSON, and how long what was read of it was."""

    dumps = staticmethod(json.dumps)
    length = 0

    @classmethod
    def loads(cls, text: str) -> object:
        """Read it."""
        cls.length += len(text)
        return json.loads(text)


class Looker:
    """One page that is looked at."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._next = self.messages = self.losses = 0
        self._socket = socketio.AsyncClient(json=Counted)
        self._socket.on("*", self._told)
        self._socket.on("disconnect", self._lost)

    async def open(self, http: httpx.AsyncClient) -> None:
        """Get the page and connect."""
        text = (await http.get(self._address)).raise_for_status().text
        found = NAMED.search(text)
        assert found is not None, text
        self._client = found.group(1)
        asked = {
            "client_id": self._client,
            "next_message_id": 0,
            "implicit_handshake": "true",
            "document_id": str(uuid.uuid4()),
            "tab_id": str(uuid.uuid4()),
        }
        parts = urlsplit(self._address)
        address = f"{parts.scheme}://{parts.netloc}?{urlencode(asked)}"
        path = "/_nicegui_ws/socket.io"
        await self._socket.connect(address, socketio_path=path, transports=["websocket"])

    async def acknowledge(self) -> None:
        """Say what was taken, as pages do."""
        if self._socket.connected:
            await self._socket.emit("ack", {"client_id": self._client, "next_message_id": self._next})

    async def close(self) -> None:
        """Leave."""
        await self._socket.disconnect()

    def _lost(self, _reason: str) -> None:
        self.losses += 1

    async def _told(self, _event: str, message: dict[str, object]) -> None:
        self._next = int(str(message["_id"])) + 1
        self.messages += 1


async def look(address: str, count: int) -> None:
    """Look until standard input ends."""
    lookers = [Looker(address) for _ in range(count)]
    async with httpx.AsyncClient(timeout=300) as http:
        for one in lookers:
            await one.open(http)
    loop = asyncio.get_running_loop()
    ended = loop.run_in_executor(None, sys.stdin.read)
    messages, length = sum(one.messages for one in lookers), Counted.length
    print("ready", flush=True)
    while not ended.done():
        await asyncio.wait([ended], timeout=ACK_S)
        await asyncio.gather(*(one.acknowledge() for one in lookers))
    messages = sum(one.messages for one in lookers) - messages
    told = {
        "messages": messages,
        "sent_kB": round((Counted.length - length) / 1e3),
        "connections_lost": sum(one.losses for one in lookers),
    }
    print(json.dumps(told), flush=True)
    await asyncio.gather(*(one.close() for one in lookers))


if __name__ == "__main__":
    os.nice(19)
    asyncio.run(look(sys.argv[1], int(sys.argv[2])))
