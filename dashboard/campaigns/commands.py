"""Commands for campaigns, shared by the command line and the REST API."""

from __future__ import annotations

import contextlib

from dashboard.campaigns.events import Begin, Cancel, CannotBegin, Pause
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.campaigns.store.store import BusyError, Store
from deploy.errors import BadSpecError

FINAL = ("done", "cancelled")
ENDED = (*FINAL, "failed")
"""Phases in which nothing is flown before somebody asks for it."""


class ConflictError(BadSpecError):
    """The command does not fit the phase of the campaign."""


def cancel(store: Store, campaign: CampaignEntry) -> None:
    """Give a campaign up; what was flown stays. Whoever flies it hears of it in a moment.

    :raises ConflictError: if it has ended.
    """
    refuse_ended(campaign)
    try:
        with store.lock(campaign):
            states = store.states(store.find(campaign.label))
            store.write(campaign, states, states.handle(Cancel()), {})
    except BusyError:
        store.set_desired_state(campaign, "cancel")


def pause(store: Store, campaign: CampaignEntry) -> None:
    """Have whoever flies a campaign leave it, and nobody take it up.

    :raises ConflictError: if it has ended.
    """
    refuse_ended(campaign)
    store.set_desired_state(campaign, "pause")
    with contextlib.suppress(BusyError), store.lock(campaign):
        states = store.states(store.find(campaign.label))
        changed = states.handle(Begin()) if states.phase == "queued" else []
        if states.phase == "running":  # whoever flew it is gone, or it has waited for its turn
            store.write(campaign, states, changed + states.handle(Pause("paused")), {})


def give_up(store: Store, campaign: CampaignEntry, reason: str) -> None:
    """End a campaign that cannot be set up as failed; nobody takes it up before it is resumed.

    :raises BusyError: if another process flies it.
    """
    with store.lock(campaign):
        states = store.states(store.find(campaign.label))
        if states.phase not in FINAL:
            store.write(campaign, states, states.handle(CannotBegin(reason)), {})
        store.set_desired_state(campaign, "")


def refuse_ended(campaign: CampaignEntry) -> None:
    """Refuse a command for a campaign that has ended.

    :raises ConflictError: if it has.
    """
    if campaign.phase in FINAL:
        message = f"{campaign.label} is {campaign.phase} already"
        raise ConflictError(message)
