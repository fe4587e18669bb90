"""Requests that come faster than they should, or too many at once."""

import asyncio

from starlette.types import Message, Receive, Scope, Send

from dashboard.api.request_limit import BURST, MOST_A_SECOND, MOST_AT_ONCE, RequestLimit


class Asked:
    """An application behind the limit, whose requests last until they are let go; and a clock."""

    def __init__(self) -> None:
        self.now = 0.0
        self.lasting = False
        self._go = asyncio.Event()
        self._limit = RequestLimit(self._answer, lambda: self.now)

    async def _answer(self, _scope: Scope, _receive: Receive, send: Send) -> None:
        if self.lasting:
            await self._go.wait()
        await send({"type": "http.response.start", "status": 200, "headers": []})

    def let_go(self) -> None:
        self._go.set()

    async def status(
        self, method: str = "POST", path: str = "/api/v1/flights"
    ) -> tuple[int, dict[bytes, bytes]]:
        sent: list[Message] = []

        async def send(message: Message) -> None:
            sent.append(message)

        async def receive() -> Message:
            return {"type": "http.request"}

        await self._limit({"type": "http", "method": method, "path": path, "headers": []}, receive, send)
        return sent[0]["status"], dict(sent[0]["headers"])


def test_a_burst_is_taken_and_what_is_more_is_to_wait() -> None:
    async def ask() -> None:
        asked = Asked()
        assert [(await asked.status())[0] for _ in range(BURST)] == [200] * BURST
        status, headers = await asked.status()
        assert (status, headers[b"retry-after"]) == (429, b"1")
        assert (await asked.status("GET"))[0] == 200
        assert (await asked.status(path="/login"))[0] == 200
        asked.now += 1.0
        later = [(await asked.status())[0] for _ in range(int(MOST_A_SECOND) + 1)]
        assert later == [200] * int(MOST_A_SECOND) + [429]
        asked.now += 1e6
        assert [(await asked.status())[0] for _ in range(BURST + 1)] == [200] * BURST + [429]

    asyncio.run(ask())


def test_only_so_many_are_worked_on_at_once_and_who_reads_is_not_among_them() -> None:
    async def ask() -> None:
        asked = Asked()
        asked.lasting = True
        tasks = [asyncio.create_task(asked.status()) for _ in range(MOST_AT_ONCE)]
        reading = [asyncio.create_task(asked.status("GET")) for _ in range(30)]
        await asyncio.sleep(0)
        assert (await asked.status("DELETE"))[0] == 429
        asked.let_go()
        assert [status for status, _ in await asyncio.gather(*tasks, *reading)] == [200] * (MOST_AT_ONCE + 30)
        assert (await asked.status("DELETE"))[0] == 200

    asyncio.run(ask())
