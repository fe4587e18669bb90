"""What people do to campaigns, at the command line and over HTTP alike."""

from __future__ import annotations

import contextlib

from dashboard.campaigns.events import Begin, Cancel, CannotBegin, Pause
from dashboard.campaigns.store import BusyError, Campaign, Store
from deploy.check import BadSpecError

FINAL = ("done", "cancelled")
ENDED = (*FINAL, "failed")
"""Phases in which nothing is flown before somebody asks for it."""


class ConflictError(BadSpecError):
    """What is asked for does not go with where the campaign stands."""


def cancel(store: Store, found: Campaign) -> None:
    """Give a campaign up; what was flown stays. Whoever flies it hears of it in a moment.

    :raises ConflictError: if it has ended.
    """
    refuse_ended(found)
    try:
        with store.lock(found):
            states = store.states(store.find(found.label))
            store.write(found, states, states.handle(Cancel()), {})
    except BusyError:
        store.wish(found, "cancel")


def pause(store: Store, found: Campaign) -> None:
    """Have whoever flies a campaign leave it, and nobody take it up.

    :raises ConflictError: if it has ended.
    """
    refuse_ended(found)
    store.wish(found, "pause")
    with contextlib.suppress(BusyError), store.lock(found):
        states = store.states(store.find(found.label))
        changed = states.handle(Begin()) if states.phase == "queued" else []
        if states.phase == "running":  # whoever flew it is gone, or it has waited for its turn
            store.write(found, states, changed + states.handle(Pause("paused")), {})


def give_up(store: Store, found: Campaign, reason: str) -> None:
    """End a campaign that cannot be set up as failed; nobody takes it up before it is resumed.

    :raises BusyError: if another process flies it.
    """
    with store.lock(found):
        states = store.states(store.find(found.label))
        if states.phase not in FINAL:
            store.write(found, states, states.handle(CannotBegin(reason)), {})
        store.wish(found, "")


def refuse_ended(found: Campaign) -> None:
    """Only what has not ended can be steered.

    :raises ConflictError: if it has.
    """
    if found.phase in FINAL:
        message = f"{found.label} is {found.phase} already"
        raise ConflictError(message)
