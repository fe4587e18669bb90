"""The real service, as a process of its own."""

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest

from dashboard.client import Client
from services.system.lifeline import die_with_parent
from tests.conftest import wait_until

PATIENCE_S = 300.0


@dataclass
class Serving:
    """A service that answers at ``address``; ``said`` is its log."""

    process: "subprocess.Popen[bytes]"
    address: str
    said: Path

    def kill(self) -> None:
        """As a crash would."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()


@contextmanager
def serving(folder: Path, *arguments: str, store: str = "", port: int = 0) -> Iterator[Serving]:
    """A service on a free port of this machine, ready; ``store`` is a URL, if not the folder."""
    if not port:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
    folder.mkdir(parents=True, exist_ok=True)
    said = folder / "service.log"
    command = [
        sys.executable,
        "-m",
        "dashboard",
        "serve",
        "--store",
        store or str(folder),
        "--port",
        str(port),
    ]
    with said.open("ab") as log:
        process = subprocess.Popen(
            [*command, *arguments],
            stdout=log,
            stderr=log,
            env=dict(os.environ),
            preexec_fn=die_with_parent,  # noqa: PLW1509 - one system call
        )
    one = Serving(process, f"http://127.0.0.1:{port}", said)

    def ready() -> bool:
        assert process.poll() is None, said.read_text()
        try:
            return httpx.get(f"{one.address}/ready", timeout=30).is_success
        except httpx.TransportError:
            return False

    try:
        wait_until(ready, PATIENCE_S)
        yield one
    finally:
        if process.poll() is None:
            process.terminate()
            process.wait(PATIENCE_S)


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    """One service for a file of tests."""
    with serving(tmp_path_factory.mktemp("service")) as one:
        yield one


@pytest.fixture
def client(service: Serving) -> Iterator[Client]:
    """Its client."""
    with Client(service.address) as one:
        yield one
