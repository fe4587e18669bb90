"""A Zenoh router on loopback, as rmw_zenohd is one, and nodes of another implementation of the scheme."""

import json
import socket
from collections.abc import Iterator
from typing import Any

import pytest
import zenoh

from tests.fixtures import ros_nodes


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    """Where a router listens."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        number = int(free.getsockname()[1])
    config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": "router",
        "listen/endpoints": [f"tcp/127.0.0.1:{number}"],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config):
        yield number
        ros_nodes.close()


@pytest.fixture
def endpoint(port: int) -> str:
    return f"tcp/127.0.0.1:{port}"
