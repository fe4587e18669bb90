"""Fly one mission: start its processes, record its messages, restart crashed nodes, build its outcome."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from deploy.config.workdir import mission_folder
from deploy.errors import InfrastructureError
from deploy.mission.companion_orders import FlightTerms
from deploy.mission.far_processes import Companion, TwoHostProcesses
from deploy.mission.fork_server import ForkServer
from deploy.mission.judgement import judge_properties
from deploy.mission.listening import MissionBus
from deploy.mission.outcome import MissionEnd, mission_outcome
from deploy.mission.restarts import POLL_S, RestartPolicy
from deploy.mission.setups import NodeSetups, armed_call
from deploy.mission.silence import STALL_S, Silence
from deploy.mission.supervisor import Supervisor
from deploy.recording.mcap_recorder import MessageTap
from deploy.recording.ordering import MessageOrder, SentMessage
from deploy.recording.recorder import FlightRecorder, FlightTrace
from services.bus import session
from services.bus.horizon import Stamped
from services.kernels import aimed_at
from services.models.detection import DETECTOR
from services.models.mission import MissionSpec
from services.models.outcome import Outcome
from services.runtime.clock import FlightClock
from sim.mission.true_path import TruePath, read

NODES = 5
"""At most so many are in a step at once, each with the thread time that a hang is granted."""

GRACE_S = 2.0
"""Longest wait for the processes to end by themselves after the mission."""


@dataclass(frozen=True, slots=True)
class FlownMission:
    """An outcome with what a golden twin is compared by, and the messages if they were kept.

    That is the trace of messages, the true path, and the virtual time of the mission's end.
    """

    outcome: Outcome
    trace: FlightTrace
    true_path: TruePath
    end_ns: int
    messages: Mapping[str, Sequence[Stamped]] | None = None
    late: int = 0


Watch = Callable[[MissionSpec, FlightRecorder], None]
"""Is given the recorder of each flight as it begins, to look into from another thread."""


def fly(
    spec: MissionSpec,
    server: ForkServer,
    *,
    keep_messages: bool = False,
    watch: Watch | None = None,
    taps: Sequence[MessageTap] = (),
) -> FlownMission:
    """Fly one mission on a fork server; a pure function of ``spec`` as far as virtual time goes.

    ``keep_messages`` gives the caller every recorded message up to the end of the mission, by topic; ``taps``
    are given the same meanwhile, and injection and alarms, in the order of virtual time. Here properties are
    judged of a flight without a fault only; others are judged beside their twin.

    :raises DisturbedFlightError: if a process was ended from outside.
    :raises InfrastructureError: if the infrastructure failed. A crashed vehicle or node returns normally.
    """
    begin = time.monotonic()
    recorder = FlightRecorder()
    if watch is not None:
        watch(spec, recorder)
    with mission_folder() as folder:
        address = session.BusAddress(folder, f"zenfi/{folder.name}")
        clock = address.clock if spec.clock == "realtime" else None
        if clock is not None:
            FlightClock.create(clock)
        companion = server.companion
        more = companion.bus_settings if companion is not None else {}
        with session.open_session(address, "router", router=True, more=more) as bus:
            held = spec.fault is not None or spec.detector is not None
            order = MessageOrder(recorder, held=held, realtime=clock is not None)
            recurs = spec.fault is not None and spec.fault.recurs
            listening = MissionBus(bus, recorder, order, recurs=recurs)
            fault = spec.fault
            traced = aimed_at(fault) if fault is not None and fault.recurs_in_instructions else ""
            terms = FlightTerms(
                namespace=address.namespace,
                hang_cpu_s=spec.limits.hang_cpu_s,
                traced=traced,
                armed=armed_call(fault),
            )
            with _processes(server, address, terms, companion) as processes:
                true_path = folder / "true_path.f64"
                mission = _Mission(
                    spec, server, processes, listening, NodeSetups(spec, server.stack, clock, true_path)
                )
                flown = mission.fly(order, taps, true_path, keep_messages=keep_messages)
    # All that a flight takes, its end included.
    outcome = flown.outcome.model_copy(update={"wall_s": time.monotonic() - begin})
    return replace(flown, outcome=outcome)


@contextmanager
def _processes(
    server: ForkServer, address: session.BusAddress, terms: FlightTerms, companion: Companion | None
) -> Iterator[Supervisor | TwoHostProcesses]:
    """The processes of a mission, none started yet; whatever is left of them in the end is killed."""
    here = Supervisor(server, address, terms.hang_cpu_s, traced=terms.traced, armed=terms.armed)
    with closing(here):
        if companion is None:
            yield here
            return
        with TwoHostProcesses.opened(here, companion, terms, address.folder) as processes:
            yield processes


class _Mission:
    """The loop of one mission over its messages and its processes."""

    def __init__(
        self,
        spec: MissionSpec,
        server: ForkServer,
        supervisor: Supervisor | TwoHostProcesses,
        bus: MissionBus,
        setups: NodeSetups,
    ) -> None:
        self._spec = spec
        self._server = server
        self._supervisor = supervisor
        self._bus = bus
        self._end = MissionEnd()
        self._setups = setups
        self._restarts = RestartPolicy(spec, supervisor, self._setups, bus, self._end)

    def fly(
        self, order: MessageOrder, taps: Sequence[MessageTap], true_path: Path, *, keep_messages: bool
    ) -> FlownMission:
        """Fly from the start of the processes to their end."""
        bus, recorder, end = self._bus, self._bus.recorder, self._end
        for process in self._setups.processes:
            self._supervisor.start(process, self._setups.of(process))
        self._run(order, taps)
        self._restarts.await_dead_detector()
        self._supervisor.end(GRACE_S, lambda: bus.take_in(0.001))
        if self._server.is_lost():  # and has taken with it what nodes had still to count
            raise InfrastructureError("the fork server was lost in mid flight")
        _offer(taps, order.rest(end.time_ns))
        trace = recorder.trace(end.time_ns)
        outcome = mission_outcome(
            self._spec, end, trace, bus, self._supervisor.members, fixed_pids=self._server.stage_pids_fixed
        )
        path = read(true_path, end.time_ns)
        if self._spec.fault is None:
            judged = judge_properties(self._spec, path, path)
            outcome = outcome.model_copy(update={"properties": judged})
        messages = recorder.until(end.time_ns) if keep_messages else None
        return FlownMission(outcome, trace, path, end.time_ns, messages, order.late)

    def _run(self, order: MessageOrder, taps: Sequence[MessageTap]) -> None:
        """Handle messages and processes until all up to the mission's end is recorded."""
        bus, recorder, end = self._bus, self._bus.recorder, self._end
        last_look = bus.last_message_s = time.monotonic()
        silence = Silence(self._supervisor, NODES * self._spec.limits.hang_cpu_s)
        while end.result is None or not recorder.complete(end.time_ns):
            if bus.take_in(POLL_S):
                end.look(recorder)
                if taps:
                    _offer(taps, order.take(end.time_ns))
            since_s = time.monotonic() - last_look
            if since_s > POLL_S:
                silence.look(since_s, heard=bus.last_message_s > last_look)
                last_look += since_s
                self._restarts.handle_deaths()
                self._supervisor.kill_hung()
                if silence.is_stall():
                    self._handle_stall()
            if end.result == "stack_failure":
                return

    def _handle_stall(self) -> None:
        """Kill the process that keeps all others waiting without computing.

        That is the node which the fault strikes, in the life in which it does: one that was restarted since
        waits through a failure of ours.

        :raises InfrastructureError: if none is to blame.
        """
        members = self._supervisor.members
        if any(one.alive and one.stats.page["gated"] for one in members.values()):
            return  # probes are under way; should the injector die of it, that is noticed
        if any(one.alive and one.stats.page["asking"] for one in members.values()):
            # It hangs without computing, as when it was stopped: the stage that asks would wait for ever.
            self._supervisor.kill_as_hung(members[DETECTOR])
            return
        fault = self._spec.fault
        struck = members[aimed_at(fault)] if fault is not None else None
        if fault is None or struck is None or not struck.alive or (struck.life > 0 and not fault.recurs):
            tails = "; ".join(f"{one.process.name}: {one.log_tail}" for one in members.values())
            message = f"no process sent a message for {STALL_S:.0f} s ({tails})"
            raise InfrastructureError(message)
        self._supervisor.kill_as_hung(struck)


def _offer(taps: Sequence[MessageTap], batch: Sequence[SentMessage]) -> None:
    for tap in taps if batch else ():
        tap.offer(batch)
