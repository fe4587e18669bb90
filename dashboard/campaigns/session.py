"""Flying what is left of a stored campaign: for the command and for services alike; prints nothing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress

from dashboard.campaigns.executors.choice import open_executor
from dashboard.campaigns.executors.spec import ExecutorSpec
from dashboard.campaigns.recording import ArtefactRecorder
from dashboard.campaigns.scheduler import Scheduler
from dashboard.campaigns.stopping import StoppingRule
from dashboard.campaigns.store.database import StoreError, StoreFullError
from dashboard.campaigns.store.queries import CampaignEntry
from dashboard.campaigns.store.store import Store
from deploy.errors import InfrastructureError
from deploy.recording.live_feed import SOCKET
from deploy.workers.protocol import WorkerOrder
from services.models.mission import MissionSpec


@contextmanager
def scheduling(
    store: Store, campaign: CampaignEntry, executor: ExecutorSpec, slots: int | None
) -> Iterator[Scheduler]:
    """The scheduler of a campaign, which is ours alone meanwhile; to be flown by ``scheduler.fly()``.

    Leaving by an exception that is nobody's bug pauses the campaign. Another thread may ask for the same by
    ``scheduler.stop()``. Everything that was started has ended on the way out.

    :raises BusyError: if another process flies it.
    :raises BadSpecError: if the executor cannot be had.
    """
    limits = campaign.spec.limits
    with store.lock(campaign), ExitStack() as stack:
        planned = store.planned(campaign)
        used = store.file_counts(campaign).get("kept", (0, 0))[1]
        recorder = ArtefactRecorder(
            campaign.spec.recording, store.artefacts(campaign), campaign.spec.mission.seed, used
        )

        def order(run: int, spec: MissionSpec) -> WorkerOrder:
            about = {"campaign": campaign.label, "run": str(run)}
            live = store.folder / SOCKET
            return WorkerOrder(
                spec=spec,
                record=recorder.path(run, planned[run].index),
                about=about,
                live=live if live.is_socket() else None,
                flown=store.folder / "flown",
            )

        running = stack.enter_context(
            closing(open_executor(executor, slots, limits.lease_s, store.artefacts(campaign), order))
        )
        rule = StoppingRule(campaign.spec.stop, planned.values(), campaign.spec.runs)
        for record in store.records(campaign):
            result = record.result
            if result is not None:
                harm = bool(result.harm) if result.harm is not None else None
                rule.add(record.cell, record.number, success=result.success, harm=harm)
        scheduler = Scheduler(
            store.states(campaign),
            planned,
            running,
            rule,
            limits.lease_s,
            lambda states, changed, outcomes: store.write(
                campaign, states, changed, outcomes, recorder.file(planned, outcomes)
            ),
            lambda: store.desired_state(campaign),
            fly_all=campaign.spec.fly_all,
        )
        try:
            yield scheduler
        except KeyboardInterrupt:
            _leave(scheduler, "interrupted")
            raise
        except StoreFullError as error:
            _leave(scheduler, "the store is full")
            message = (
                f"{campaign.label} is paused: {error}; nothing is lost: make room on the disk or in the "
                f"quota (--disk-mb), then zenfi campaign resume {campaign.label}"
            )
            raise InfrastructureError(message) from error
        except StoreError as error:
            message = (
                f"{campaign.label} is interrupted: {error}; go on with zenfi campaign resume {campaign.label}"
            )
            raise InfrastructureError(message) from error
        except InfrastructureError as error:
            _leave(scheduler, str(error))
            raise


def _leave(scheduler: Scheduler, reason: str) -> None:
    # On a full disk the state cannot be written either; without a scheduler it reads as interrupted.
    with suppress(StoreError):
        scheduler.pause(reason)
