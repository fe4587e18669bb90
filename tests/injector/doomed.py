"""An injector that gets as far as it is told and then waits to be killed: ``doomed STAGE PID``."""

import signal
import sys
import threading

from injector.faults.stopped_thread import stand, step
from injector.tracing.perf_events import ThreadTimer, await_trap
from injector.tracing.process import Process, ProcessIdentity
from injector.tracing.tracees import TraceeGroup

PERIOD_NS = 10_000_000


def main(stage: str, pid: int) -> None:
    # A sidecar has other threads, which outlive the tracing one when it is killed.
    threading.Thread(target=threading.Event().wait, daemon=True).start()
    with Process(ProcessIdentity.of(pid)) as process, TraceeGroup() as tracees:
        tracees.seize([pid])
        thread = tracees.threads[pid]
        with ThreadTimer(thread, PERIOD_NS):
            if stage == "timed":
                wait_for_the_end()
            assert await_trap(tracees, thread, lambda: False, 30) == "trapped"
        if stage == "trapped":
            wait_for_the_end()
        tracees.stop_all()
        if stage == "standing":
            wait_for_the_end()
        _, instruction = stand(thread, process)
        step(tracees, thread, instruction)
        tracees.stop_all()
        wait_for_the_end()


def wait_for_the_end() -> None:
    print("here", flush=True)  # noqa: T201
    while True:
        signal.pause()  # the heartbeat of a pause ends it every 10 ms


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
