"""One life of the service: ``zenfi serve``."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Sequence
from pathlib import Path
from types import FrameType

import uvicorn

from dashboard.api.app import make_app
from dashboard.api.processes.campaign_runner import CampaignRunner
from dashboard.api.processes.event_bus import EventBus
from dashboard.api.processes.program_runner import ProgramRunner
from dashboard.api.processes.program_studies import FOLDER, ProgramStudies, allowed_programs
from dashboard.api.programs import named
from dashboard.api.routes.metrics import log_to_stderr
from dashboard.api.security import is_loopback, token_hash
from dashboard.api.service import Service
from dashboard.campaigns.store.store import Store
from deploy.errors import BadSpecError

STREAMS_END_S = 5
"""Clients that do not take the last events within this time are cut off when the service ends."""


class _Server(uvicorn.Server):
    """Ends its streams as soon as it is told to end: it would wait for them."""

    def __init__(self, config: uvicorn.Config, event_bus: EventBus) -> None:
        super().__init__(config)
        self._event_bus = event_bus

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:  # noqa: ARG002 - uvicorn's
        """Leave in order, with status 0; uvicorn would end by the signal."""
        self._event_bus.close()
        self.should_exit = True


def serve(
    where: str,
    host: str,
    port: int,
    slots: int | None,
    stacks: Sequence[Path] = (),
    programs_in: Path | None = None,
) -> None:
    """Serve until SIGTERM or SIGINT; campaigns are then paused, and gone on with by the next life.

    Who asks may have the programs in the files ``stacks`` flown, and no others; and runs struck of the
    programs in the files of the folder ``programs_in``.

    :raises BadSpecError: if the store or the address cannot be had, or a file is not what it should be.
    """
    from dashboard.web.site import mount  # noqa: PLC0415 - slow to import, and only a server has pages

    log_to_stderr()
    programs = named(stacks)
    allowed = allowed_programs(programs_in) if programs_in is not None else {}
    with contextlib.ExitStack() as stack:
        store = stack.enter_context(contextlib.closing(Store(where)))
        store.database.refuse_read_only()
        token = _token(store, host)
        listening = stack.enter_context(contextlib.closing(_listen(host, port)))
        event_bus = EventBus()
        studies = ProgramRunner(ProgramStudies(store.folder / FOLDER, allowed), event_bus, slots)
        service = Service(store, event_bus, CampaignRunner(store, event_bus, slots), studies, programs)
        app = make_app(service, token, loopback=is_loopback(host))
        mount(app, service)
        config = uvicorn.Config(
            app,
            log_config=None,
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=STREAMS_END_S,
            ws="websockets-sansio",
            ws_max_size=1 << 16,
            # Charts as text: to make them smaller takes longer than to send them.
            ws_per_message_deflate=False,
        )
        service.runner.start()
        studies.start()
        try:
            _Server(config, event_bus).run([listening])
        finally:
            studies.leave()
            service.runner.stop()
            studies.stop()


def _token(store: Store, host: str) -> str:
    """The hash of the store's token, empty if there is none; beyond loopback there must be one."""
    token = token_hash(store.folder)
    if not token and not is_loopback(host):
        message = f"--host {host}: others could reach it, so it needs a token: zenfi token new"
        raise BadSpecError(message)
    return token


def _listen(host: str, port: int) -> socket.socket:
    """A listening socket; closed to programs that we start."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        listening = socket.socket(family, kind, protocol)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(address)
        listening.listen(128)
    except OSError as error:
        message = f"--host {host} --port {port}: {error.strerror}"
        raise BadSpecError(message) from error
    return listening
