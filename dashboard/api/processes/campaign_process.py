"""The process that flies one campaign for the service.

Run as ``python -m dashboard.api.processes.campaign_process PARENT LABEL``.

It reads from standard input where the store is, writes what happens to standard output, a line of JSON
each (:class:`dashboard.api.processes.events.ProcessMessage`), and dies with the service. SIGTERM: it pauses
the campaign and ends; what is finished is kept.
"""

from __future__ import annotations

import contextlib
import signal
import sys
from types import FrameType

from dashboard.api.processes.events import FlightEvent, ProcessMessage, RunEvent, SightEvent
from dashboard.campaigns.commands import ENDED, FINAL
from dashboard.campaigns.flight_record import Result
from dashboard.campaigns.scheduler import Finished, Scheduler
from dashboard.campaigns.session import scheduling
from dashboard.campaigns.state_machine import CampaignStates
from dashboard.campaigns.store.database import StoreError
from dashboard.campaigns.store.listing import CampaignLine, line
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.campaigns.store.store import Store
from deploy.errors import BadSpecError, InfrastructureError
from deploy.recording.flight_status import FlightStatus
from deploy.recording.snapshot import FlightSnapshot
from services.system.lifeline import die_with_parent


def main() -> None:
    """Entry point; the exit status is 0 if there is no more to do, 130 if it was told to leave."""
    parent, label, *slots = sys.argv[1:]
    die_with_parent(int(parent))
    signal.signal(signal.SIGTERM, _leave)
    try:
        with contextlib.closing(Store(sys.stdin.readline().rstrip("\n"))) as store:
            _fly(store, store.find(label), int(slots[0]) if slots else None)
    except (BadSpecError, InfrastructureError, StoreError) as error:
        print(f"{label}: {error}", file=sys.stderr)  # noqa: T201 - the service keeps it
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)


def _leave(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _fly(store: Store, campaign: CampaignEntry, slots: int | None) -> None:
    failed = False
    try:
        if campaign.phase not in FINAL:
            store.limit(campaign.spec.limits.disk_mb)
            with scheduling(store, campaign, campaign.spec.executor, slots) as scheduler:
                _watch(scheduler, campaign)
    except InfrastructureError:
        failed = True
        raise
    finally:
        left = store.find(campaign.label)
        # What has ended, or was paused by a failure, is not to be taken up again by itself.
        over = left.phase == "paused" if failed else left.phase in ENDED
        if over and left.desired_state == "fly":
            store.set_desired_state(campaign, "")
        _say(ProcessMessage(kind="campaign", event=line(store, store.find(campaign.label))))


def _watch(scheduler: Scheduler, campaign: CampaignEntry) -> None:
    before: dict[int, FlightStatus] = {}

    def look(run: int, present: FlightStatus, sight: FlightSnapshot | None) -> None:
        if sight is not None:
            _say(
                ProcessMessage(kind="sight", event=SightEvent(campaign=campaign.label, run=run, sight=sight))
            )
        if before.get(run) == present:
            return
        before[run] = present
        _say(
            ProcessMessage(
                kind="flight", event=FlightEvent(campaign=campaign.label, run=run, present=present)
            )
        )

    scheduler.watch = look
    begun = _progress(campaign, scheduler.states).model_copy(update={"phase": "running", "reason": ""})
    _say(ProcessMessage(kind="campaign", event=begun))
    try:
        for one in scheduler.fly():
            before.pop(one.id, None)
            _say(ProcessMessage(kind="run", event=_ended(campaign, one)))
            _say(ProcessMessage(kind="campaign", event=_progress(campaign, scheduler.states)))
    except KeyboardInterrupt:
        scheduler.pause("the service stopped")
        raise


def _ended(campaign: CampaignEntry, one: Finished) -> RunEvent:
    result = Result.of(one.outcome) if one.outcome is not None else None
    return RunEvent(
        campaign=campaign.label,
        run=one.id,
        **one.run.cell._asdict(),
        number=one.run.index,
        error=one.error,
        result=result,
    )


def _progress(campaign: CampaignEntry, states: CampaignStates) -> CampaignLine:
    return CampaignLine(
        campaign=campaign.label,
        phase=states.phase,
        reason=states.reason,
        runs=len(states.runs),
        done=states.count("done"),
        failed=states.count("failed"),
        created=campaign.created,
    )


def _say(told: ProcessMessage) -> None:
    sys.stdout.write(told.model_dump_json() + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
