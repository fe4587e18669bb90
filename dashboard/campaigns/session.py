"""Flying what is left of a stored campaign: for the command and for services alike; prints nothing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress

from dashboard.campaigns.database import StoreError, StoreFullError
from dashboard.campaigns.executors.choice import open_executor
from dashboard.campaigns.executors.spec import ExecutorSpec
from dashboard.campaigns.recording import Recorder
from dashboard.campaigns.scheduler import Scheduler
from dashboard.campaigns.stopping import StoppingRule
from dashboard.campaigns.store import Campaign, Store
from deploy.live import SOCKET
from deploy.order import Order
from deploy.supervisor import InfrastructureError
from services.bus.mission import MissionSpec


@contextmanager
def scheduling(
    store: Store, found: Campaign, executor: ExecutorSpec, slots: int | None
) -> Iterator[Scheduler]:
    """The scheduler of a campaign, which is ours alone meanwhile; to be flown by ``scheduler.fly()``.

    Leaving by an exception that is nobody's bug pauses the campaign. Another thread may ask for the same by
    ``scheduler.stop()``. Everything that was started has ended on the way out.

    :raises BusyError: if another process flies it.
    :raises BadSpecError: if the executor cannot be had.
    """
    limits = found.spec.limits
    with store.lock(found), ExitStack() as stack:
        planned = store.planned(found)
        used = store.filed(found).get("kept", (0, 0))[1]
        recorder = Recorder(found.spec.recording, store.artefacts(found), found.spec.mission.seed, used)

        def order(run: int, spec: MissionSpec) -> Order:
            about = {"campaign": found.label, "run": str(run)}
            live = store.folder / SOCKET
            return Order(
                spec=spec,
                record=recorder.path(run, planned[run].index),
                about=about,
                live=live if live.is_socket() else None,
            )

        crew = stack.enter_context(
            closing(open_executor(executor, slots, limits.lease_s, store.artefacts(found), order))
        )
        rule = StoppingRule(found.spec.stop, (run.cell for run in planned.values()), found.spec.runs)
        for record in store.records(found):
            if record.result is not None:
                rule.add(record.cell, record.number, success=record.result.success)
        scheduler = Scheduler(
            store.states(found),
            planned,
            crew,
            rule,
            limits.lease_s,
            lambda states, changed, outcomes: store.write(
                found, states, changed, outcomes, recorder.file(planned, outcomes)
            ),
            lambda: store.wished(found),
        )
        try:
            yield scheduler
        except KeyboardInterrupt:
            _leave(scheduler, "interrupted")
            raise
        except StoreFullError as error:
            _leave(scheduler, "the store is full")
            message = (
                f"{found.label} is paused: {error}; nothing is lost: make room on the disk or in the quota "
                f"(--disk-mb), then zenfi campaign resume {found.label}"
            )
            raise InfrastructureError(message) from error
        except StoreError as error:
            message = f"{found.label} is interrupted: {error}; go on with zenfi campaign resume {found.label}"
            raise InfrastructureError(message) from error
        except InfrastructureError as error:
            _leave(scheduler, str(error))
            raise


def _leave(scheduler: Scheduler, reason: str) -> None:
    # On a full disk the state cannot be written either; without a scheduler it reads as interrupted.
    with suppress(StoreError):
        scheduler.pause(reason)
