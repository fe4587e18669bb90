"""A connection to a service: requests, whose answers are validated, and streams of events."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

import httpx
from pydantic import BaseModel

from dashboard.api.problems import MEDIA_TYPE, Problem
from dashboard.api.processes.events import FlightEvent, LostEvent, ProcessEvent, RunEvent
from dashboard.campaigns.store.listing import CampaignLine
from services.models.base import Strict

TIMEOUT_S = 60.0
SILENCE_S = 45.0
"""A stream without even a ping for this time is broken."""

PAUSE_S = 1.0
"""Wait before a broken stream is opened again."""

ATTEMPTS = 30
"""How often a request is sent while the service says that it has too many."""

TOO_MANY = 429

Told = CampaignLine | RunEvent | FlightEvent | ProcessEvent | LostEvent
_TOLD: dict[str, type[Strict]] = {
    "campaign": CampaignLine,
    "run": RunEvent,
    "flight": FlightEvent,
    "process": ProcessEvent,
    "lost": LostEvent,
}
Model = TypeVar("Model", bound=BaseModel)


class RequestRefusedError(Exception):
    """The service answered with an error; ``problem`` says why."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem.detail)
        self.problem = problem


@dataclass(frozen=True, slots=True)
class StreamEvent:
    """An event of a stream; a later request can continue after its ``id``."""

    id: str
    kind: str
    data: Any


class ServiceConnection:
    """Sends requests to the service at ``address`` and validates its answers."""

    def __init__(self, address: str, token: str | None) -> None:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        self._http = httpx.Client(base_url=f"{address}/api/v1", headers=headers, timeout=TIMEOUT_S)

    def close(self) -> None:
        """Close the connections to the service."""
        self._http.close()

    def ask(self, model: type[Model], method: str, path: str, **request: Any) -> Model:
        """The answer to a request, validated as ``model``."""
        return model.model_validate_json(self.response(method, path, **request).content)

    def response(self, method: str, path: str, **request: Any) -> httpx.Response:
        """Send a request and return its answer; sent again for some time while the service takes no more.

        :raises RequestRefusedError: if the service answers with an error.
        """
        response = self._http.request(method, path, **request)
        for _ in range(ATTEMPTS - 1):
            if response.status_code != TOO_MANY:
                break
            time.sleep(float(response.headers.get("retry-after", PAUSE_S)))
            response = self._http.request(method, path, **request)
        if response.is_error:
            raise _refused(response)
        return response

    def stream(self, path: str, after: str | None) -> Iterator[StreamEvent]:
        """Events of a stream until it ends, from the one that follows the event ``after``."""
        headers = {"Last-Event-ID": after} if after else {}
        with self._http.stream("GET", path, headers=headers, timeout=SILENCE_S) as response:
            if response.is_error:
                response.read()
                raise _refused(response)
            fields: dict[str, str] = {}
            for line in response.iter_lines():
                name, _, value = line.partition(": ")
                if line and name:
                    fields[name] = value
                elif not line and "data" in fields:
                    kind = fields["event"]
                    yield StreamEvent(
                        fields["id"], kind, _TOLD[kind].model_validate(json.loads(fields["data"]))
                    )
                    fields = {}


def _refused(response: httpx.Response) -> RequestRefusedError:
    if response.headers.get("content-type") == MEDIA_TYPE:
        return RequestRefusedError(Problem.model_validate_json(response.content))
    detail = f"{response.reason_phrase}: is it a service of zenfi?"
    return RequestRefusedError(
        Problem(title=response.reason_phrase, status=response.status_code, detail=detail)
    )
