"""Policy for the death of a process: the end of the mission, a restart, or an infrastructure error."""

from __future__ import annotations

import time

from deploy.errors import InfrastructureError
from deploy.mission.far_processes import TwoHostProcesses
from deploy.mission.fork_protocol import EXIT_BUG
from deploy.mission.listening import MissionBus
from deploy.mission.outcome import MissionEnd
from deploy.mission.setups import NodeSetups
from deploy.mission.supervisor import SupervisedNode, Supervisor
from services.bus.horizon import NEVER_NS, Promise
from services.models.detection import DETECTOR
from services.models.mission import MissionSpec
from services.runtime.bus_proxy import LIFE_SHIFT

POLL_S = 0.02
"""Wall time between two looks at the processes while no message comes."""

BURIAL_S = 2.0
"""Longest wait for the end of a detector that is known to be dead."""


class RestartPolicy:
    """Restarts crashed stages, and ends the mission if an essential process died."""

    def __init__(
        self,
        spec: MissionSpec,
        supervisor: Supervisor | TwoHostProcesses,
        setups: NodeSetups,
        bus: MissionBus,
        end: MissionEnd,
    ) -> None:
        self._spec = spec
        self._supervisor = supervisor
        self._setups = setups
        self._bus = bus
        self._recorder = bus.recorder
        self._end = end

    def handle_deaths(self) -> None:
        """Deal with every process that has ended since the last call.

        :raises InfrastructureError: if one ended by our failure, or the injector died.
        """
        for member, exited in self._supervisor.deaths():
            name = member.process.name
            if exited.status == 0:
                continue
            if exited.status == EXIT_BUG and (self._spec.fault is None or member.process.essential):
                message = f"{name}: {member.log_tail}"
                raise InfrastructureError(message)
            if name == "injector":
                message = f"the injector died: {member.causes[-1]}"
                raise InfrastructureError(message)
            if member.process.with_detector:
                continue  # the stages go on without verdicts
            self._end.look(self._recorder)
            if member.process.essential:
                self._end.fail(f"{name}: {member.causes[-1]}", self._recorder)
            else:
                self._replace(member)

    def await_dead_detector(self) -> None:
        """Wait for the end of a detector that left questions unanswered.

        :raises InfrastructureError: if it is alive: then requests got lost, an infrastructure error.
        """
        self._supervisor.refresh()
        members = self._supervisor.members
        ungated = sum(int(one.stats.page["ungated"]) for one in members.values())
        deadline = time.monotonic() + BURIAL_S
        while ungated and members[DETECTOR].alive:
            if time.monotonic() > deadline:
                message = f"{ungated} questions to the detector, which is alive, were not answered"
                raise InfrastructureError(message)
            self._bus.take_in(POLL_S)
            self.handle_deaths()

    def _replace(self, member: SupervisedNode) -> None:
        """Promise on a dead node's behalf how long it will be silent, and restart it if it may be."""
        stage, limits = member.process.name, self._spec.limits
        silent_until = self._recorder.silent_until_ns(stage)
        died_ns = int(member.stats.page["step_ns"])
        # After the end nobody is started again, but who waits for this stage must learn that it is silent.
        allowed = limits.restarts if "restart" in self._spec.active_guards else 0
        may_restart = member.life < allowed and self._end.result is None
        start_ns = (
            max(silent_until, died_ns + round(limits.restart_delay_s * 1e9)) if may_restart else NEVER_NS
        )
        self._promise_for(stage, member.life + 1, start_ns)
        if may_restart:
            members = self._supervisor.members
            setup = self._setups.of(member.process).model_copy(
                update={
                    "expected": [name for name in self._setups.names if members[name].alive or name == stage],
                    "life": member.life + 1,
                    "start_ns": start_ns,
                    "published": self._recorder.published(stage),
                    "resume_from": self._recorder.resume_from(start_ns),
                }
            )
            self._supervisor.start(member.process, setup)

    def _promise_for(self, stage: str, life: int, start_ns: int) -> None:
        counts = list(self._recorder.published(stage).values())
        promise = Promise(
            serial=life << LIFE_SHIFT,
            # Older triggers are done with: the new process will not know them. Later ones await it.
            accepted_ns=start_ns - 1,
            busy_until_ns=start_ns,
            until_ns=(start_ns,) * len(counts),
            published=tuple(counts),
        )
        self._bus.promise(stage, promise.packed())
