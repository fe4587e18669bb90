"""The stack on Zenoh: where its processes announce themselves, and where its state is published.

The supervisor's session is the router of the stack's processes: ``ZENFI_STACK`` is the folder and
``ZENFI_NAMESPACE`` the namespace of their :class:`services.bus.session.BusAddress`. Zenoh calls back on
threads of its own; all that happens there is to hand over to the supervisor's loop.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import zenoh
from pydantic import ValidationError

from deploy.compose.control import ProcessView, StackView
from deploy.compose.stack_file import Bus
from deploy.compose.system.process_tree import MARK, NAMESPACE
from deploy.config.link_security import access_control, tls_settings
from services.bus import announce
from services.bus.session import BusAddress, hand_over, open_session

STATE = "supervisor/state"
"""Answers queries with a :class:`StackView`."""

_ROUTER = "router"
_ALL_STACKS = f"zenfi/stack/*/*/{STATE}"
_QUERY_S = 3.0


def changes_key(process: str) -> str:
    """Where each change of a process is published, as a :class:`ProcessView`."""
    return f"supervisor/processes/{process}"


def host() -> str:
    """The name of this machine as a chunk of a key."""
    return re.sub(r"[^A-Za-z0-9._-]", "_", socket.gethostname()) or "localhost"


def namespace(stack: str) -> str:
    """The namespace of a stack on this machine."""
    return f"zenfi/stack/{host()}/{stack}"


def own_address() -> BusAddress | None:
    """Where a process of a stack finds the others of its stack; None if it is of no stack."""
    folder = os.environ.get(MARK)
    return BusAddress(Path(folder), os.environ[NAMESPACE]) if folder else None


class StackBus:
    """The supervisor's Zenoh session: it follows announcements, publishes changes and answers queries."""

    def __init__(self, folder: Path, stack: str, beyond: Bus) -> None:
        self._loop = asyncio.get_running_loop()
        self.session = open_session(
            BusAddress(folder, namespace(stack)), _ROUTER, router=True, more=_settings(folder, beyond)
        )
        self._tokens: set[str] = set()
        self._declared: list[zenoh.Subscriber[None] | zenoh.Queryable[None]] = []

    def listen(self, announced: Callable[[], None], tell: Callable[[], StackView]) -> None:
        """Call ``announced`` in the loop when a process announces itself; answer queries with ``tell``."""

        def token(key: str, present: bool) -> None:
            (self._tokens.add if present else self._tokens.discard)(key)
            if present:
                announced()

        def heard(sample: zenoh.Sample) -> None:
            self._hand_over(token, str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        def answer(query: zenoh.Query) -> None:
            with query:
                query.reply(STATE, tell().model_dump_json())

        self._declared.append(
            self.session.liveliness().declare_subscriber(announce.ALL, hand_over(heard), history=True)
        )
        self._declared.append(
            self.session.declare_queryable(STATE, hand_over(lambda query: self._hand_over(answer, query)))
        )

    def _hand_over(self, call: Callable[..., None], *arguments: object) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed: we are leaving
            self._loop.call_soon_threadsafe(call, *arguments)

    def announcements(self, name: str) -> Iterator[announce.Announcement]:
        """The announcements under that name that still stand."""
        for key in self._tokens:
            with contextlib.suppress(ValueError):
                claim = announce.Announcement.parse(key)
                if claim.name == name:
                    yield claim

    def first_message(self, key: str, call: Callable[[], None]) -> zenoh.Subscriber[None]:
        """Call ``call`` in the loop for each message on ``key`` until the subscriber is undeclared."""
        return self.session.declare_subscriber(key, hand_over(lambda _: self._hand_over(call)))

    def publish(self, view: ProcessView) -> None:
        """Publish a change of one process."""
        self.session.put(changes_key(view.name), view.model_dump_json())

    def close(self) -> None:
        """Close the supervisor's Zenoh session."""
        self.session.close()  # type: ignore[no-untyped-call]


def _settings(folder: Path, beyond: Bus) -> dict[str, object]:
    """What the session has more than that of a mission's supervisor."""
    # Who is not there yet is tried again for ever, in the background.
    more: dict[str, object] = {
        "connect/exit_on_failure": False,
        "connect/timeout_ms": -1,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 5000, "period_increase_factor": 2},
    }
    if beyond.listen:
        own = BusAddress(folder, "").endpoint(_ROUTER)
        more["listen/endpoints"] = [own, *beyond.listen]
    if beyond.connect:
        more["connect/endpoints"] = list(beyond.connect)
    if beyond.tls is not None:
        more |= tls_settings(Path(beyond.tls)) | access_control()
    return more


def all_stacks(folder: Path) -> list[StackView]:
    """The stacks that the supervisor in ``folder`` knows on Zenoh, its own and those of other machines."""
    config = zenoh.Config()
    for key, value in (
        ("mode", "client"),
        ("connect/endpoints", [BusAddress(folder, "").endpoint(_ROUTER)]),
        ("scouting/multicast/enabled", False),
        ("scouting/delay", 0),
    ):
        config.insert_json5(key, json.dumps(value))
    views = []
    with zenoh.open(config) as session:
        for reply in session.get(_ALL_STACKS, timeout=_QUERY_S):
            if reply.ok is not None:
                with contextlib.suppress(ValidationError):
                    views.append(StackView.model_validate_json(reply.ok.payload.to_bytes()))
    return sorted(views, key=lambda view: (view.host, view.name))
