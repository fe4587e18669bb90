"""The process that flies one campaign for the service: ``python -m dashboard.api.pilot PARENT LABEL``.

It reads from standard input where the store is, writes what happens to standard output, a line of JSON
each (:class:`dashboard.api.events.Told`), and dies with the service. SIGTERM: it pauses the campaign and
ends; what is finished is kept.
"""

from __future__ import annotations

import contextlib
import signal
import sys
from types import FrameType

from dashboard.api.events import FlightEvent, RunEvent, SightEvent, Told
from dashboard.campaigns.database import StoreError
from dashboard.campaigns.listing import CampaignLine, line
from dashboard.campaigns.records import Result
from dashboard.campaigns.scheduler import Finished, Scheduler
from dashboard.campaigns.session import scheduling
from dashboard.campaigns.states import CampaignStates
from dashboard.campaigns.steering import ENDED, FINAL
from dashboard.campaigns.store import Campaign, Store
from deploy.check import BadSpecError
from deploy.present import Present
from deploy.sight import Sight
from deploy.supervisor import InfrastructureError
from services.bus.lifeline import die_with_parent


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


def _fly(store: Store, found: Campaign, slots: int | None) -> None:
    failed = False
    try:
        if found.phase not in FINAL:
            store.limit(found.spec.limits.disk_mb)
            with scheduling(store, found, found.spec.executor, slots) as scheduler:
                _watch(scheduler, found)
    except InfrastructureError:
        failed = True
        raise
    finally:
        left = store.find(found.label)
        # What has ended, or was paused by a failure, is not to be taken up again by itself.
        over = left.phase == "paused" if failed else left.phase in ENDED
        if over and left.wish == "fly":
            store.wish(found, "")
        _say(Told(kind="campaign", event=line(store, store.find(found.label))))


def _watch(scheduler: Scheduler, found: Campaign) -> None:
    before: dict[int, Present] = {}

    def look(run: int, present: Present, sight: Sight | None) -> None:
        if sight is not None:
            _say(Told(kind="sight", event=SightEvent(campaign=found.label, run=run, sight=sight)))
        if before.get(run) == present:
            return
        before[run] = present
        _say(Told(kind="flight", event=FlightEvent(campaign=found.label, run=run, present=present)))

    scheduler.watch = look
    begun = _progress(found, scheduler.states).model_copy(update={"phase": "running", "reason": ""})
    _say(Told(kind="campaign", event=begun))
    try:
        for one in scheduler.fly():
            before.pop(one.id, None)
            _say(Told(kind="run", event=_ended(found, one)))
            _say(Told(kind="campaign", event=_progress(found, scheduler.states)))
    except KeyboardInterrupt:
        scheduler.pause("the service stopped")
        raise


def _ended(found: Campaign, one: Finished) -> RunEvent:
    result = Result.of(one.outcome) if one.outcome is not None else None
    return RunEvent(
        campaign=found.label,
        run=one.id,
        **one.run.cell._asdict(),
        number=one.run.index,
        error=one.error,
        result=result,
    )


def _progress(found: Campaign, states: CampaignStates) -> CampaignLine:
    return CampaignLine(
        campaign=found.label,
        phase=states.phase,
        reason=states.reason,
        runs=len(states.runs),
        done=states.count("done"),
        failed=states.count("failed"),
        created=found.created,
    )


def _say(told: Told) -> None:
    sys.stdout.write(told.model_dump_json() + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
