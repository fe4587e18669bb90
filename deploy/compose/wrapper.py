"""Any process as a node of a stack: announced by a wrapper, and found again by its name."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path

from deploy.compose.bus import namespace, own_address
from deploy.compose.control import StackView, stacks_up, state
from deploy.compose.folder import StackError
from deploy.compose.system.process_tree import descendants
from injector.tracing.process import IdentityError, Process, ProcessIdentity
from services.bus import announce
from services.bus.announce import Announcement
from services.bus.session import BusAddress, open_visitor
from services.system.lifeline import die_with_parent
from services.system.process_stat import process_stat

_PASSED_ON = (signal.SIGTERM, signal.SIGINT, signal.SIGQUIT, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2)
_TOKENS_S = 3.0


class NotAnnouncedError(StackError):
    """No process of the stack is announced by that name, or what is announced is not what it should be."""


def run_announced(name: str, command: Sequence[str]) -> int:
    """Run a command, announced to the stack that this process belongs to, until it ends; its status.

    The command dies with this process, and gets the signals that ask this one to end.

    :raises StackError: if this is no process of a stack, or the command cannot be run.
    """
    address = own_address()
    if address is None:
        raise StackError("zenfi announce is the command of a process in a stack file: see docs/own_stack.md")
    own = os.getpid()
    try:
        # Before the session: it does not survive a fork.
        child = subprocess.Popen(command, preexec_fn=lambda: die_with_parent(own))  # noqa: S603, PLW1509
    except OSError as error:
        message = f"{command[0]}: {error.strerror}"
        raise StackError(message) from error
    for number in _PASSED_ON:
        signal.signal(number, lambda got, _: child.send_signal(got))
    with closing(open_visitor(address)) as session, suppress(OSError):  # it may be over already
        file = Path(f"/proc/{child.pid}/exe").stat()
        claim = announce.announcement(name, child.pid)
        claim = replace(claim, executable=(file.st_dev, file.st_ino))
        token = session.liveliness().declare_token(claim.key)
        status = child.wait()
        token.undeclare()  # type: ignore[no-untyped-call]
        return status
    return child.wait()


def the_stack(name: str | None) -> StackView:
    """The stack of that name, or the only one that is up.

    :raises StackError: if it is not up, or there is more than one.
    """
    if name is not None:
        return state(name)
    views = stacks_up()
    if len(views) != 1:
        what = ", ".join(view.name for view in views) if views else "none"
        message = f"--node: name the stack with --stack; up: {what}"
        raise StackError(message)
    return views[0]


def claims(stack: StackView) -> dict[str, Announcement]:
    """The announcements on a stack's bus, by name."""
    with closing(open_visitor(BusAddress(stack.folder, namespace(stack.name)))) as session:
        found = session.liveliness().get(announce.ALL, timeout=_TOKENS_S)
        keys = [str(reply.ok.key_expr) for reply in found if reply.ok is not None]
    parsed = [Announcement.parse(key) for key in keys]
    return {claim.name: claim for claim in sorted(parsed, key=lambda one: one.pid)}


def claim_of(stack: StackView, name: str) -> Announcement:
    """The announcement of that name on a stack's bus.

    :raises NotAnnouncedError: naming what is.
    """
    found = claims(stack)
    if name not in found:
        known = ", ".join(sorted(found)) or "nothing"
        message = f"no node {name!r} is announced in stack {stack.name}; announced: {known}"
        raise NotAnnouncedError(message)
    return found[name]


def verify(stack: StackView, claim: Announcement) -> None:
    """Check that an announcement is true, and of a process that the stack has started.

    Anybody who is on the bus may claim anything: of what the kernel reports, user, boot, start and executable
    must be as announced, and the process and its wrapper must be of the supervisor's family.

    :raises NotAnnouncedError: if it is not.
    """
    try:
        with Process(ProcessIdentity.announced(claim)):
            parent = process_stat(claim.pid).parent
        if not {parent, claim.pid} <= descendants(stack.pid).keys():
            message = f"process {claim.pid} was not started by stack {stack.name}"
            raise NotAnnouncedError(message)
    except (IdentityError, OSError) as error:
        message = f"{claim.name}: {error}"
        raise NotAnnouncedError(message) from error
