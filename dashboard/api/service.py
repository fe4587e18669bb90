"""What every endpoint needs: the store, the hub, the conductor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends
from starlette.requests import HTTPConnection

from dashboard.api.conductor import Conductor
from dashboard.api.hub import Hub
from dashboard.api.programs import Programs
from dashboard.campaigns.store import Campaign, Store


@dataclass(frozen=True, slots=True)
class Service:
    """One life of the service; ``programs`` are those that may be asked for."""

    store: Store
    hub: Hub
    conductor: Conductor
    programs: Programs = frozenset()


def _service(connection: HTTPConnection) -> Service:
    service: Service = connection.app.state.service
    return service


Here = Annotated[Service, Depends(_service)]


def _found(label: str, here: Here) -> Campaign:
    return here.store.find(label)


Found = Annotated[Campaign, Depends(_found)]
"""The campaign that the path names by its label or number."""
