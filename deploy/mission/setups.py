"""The setup of each process of a mission: its part of the specification, and latencies."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from deploy.config.platform import check_latency, latencies
from deploy.config.plug_ins import used_plug_ins
from deploy.config.processes import ProcessDeclaration
from services.kernels import KERNELS
from services.models.detection import DETECTOR
from services.models.faults.specification import FaultSpec, Trigger
from services.models.mission import MissionSpec
from services.models.oracles.harm import HarmSpec
from services.models.platform import KernelLatency
from services.runtime.setup import NodeSetup

SIMULATOR, PLANNING = "sim", "planning"


def spec_for_stages(spec: MissionSpec) -> MissionSpec:
    """The specification with no more of a fault in one instruction than its kernel, and no oracles.

    All else of such a fault is the injector's business, and which call is struck stands in the page that a
    node shares with us (:class:`~services.system.shared_stats.SharedStats`). So nodes have the same memory
    up to the call, whatever strikes there. Nor does it matter to a node what its flight is judged by.
    """
    spec = spec.model_copy(update={"properties": (), "harm": HarmSpec()})
    fault = spec.fault
    if fault is None or fault.level != "instruction" or fault.recurs:
        return spec
    return spec.model_copy(update={"fault": FaultSpec(target=fault.target)})


def armed_call(fault: FaultSpec | None) -> Trigger | None:
    """Which call a node is to stop in: a number, or a time, which counts more. None: in no single one."""
    if fault is None or fault.trigger is None or fault.level != "instruction" or fault.recurs:
        return None
    after_ns = fault.trigger.after_ns
    return Trigger(after_ns=after_ns, invocation=fault.trigger.invocation if after_ns is None else None)


class NodeSetups:
    """The processes that a mission needs of a ``stack``, in the order of their start, and their setups.

    ``clock`` is the page of the flight's clock in real time, None in virtual time; the simulator is to write
    its true path to the file ``true_path``.
    """

    def __init__(
        self,
        spec: MissionSpec,
        stack: Mapping[str, ProcessDeclaration],
        clock: Path | None,
        true_path: Path,
    ) -> None:
        self._true_path = true_path
        self._spec = spec
        self._clock = clock
        fault, detector = spec.fault, spec.detector
        injector_needed = fault is not None and fault.level == "instruction"
        self.processes = [
            one
            for one in stack.values()
            if (injector_needed or not one.with_fault)
            and (detector is not None or not one.with_detector)
            and not one.with_strikes
        ]
        self._plug_ins = used_plug_ins(spec)
        self.names = [process.name for process in self.processes]
        self._latencies: Mapping[str, KernelLatency] = latencies(spec.platform, spec.planner)
        if detector is not None:
            check = check_latency(spec.platform, detector)
            self._latencies = {**self._latencies, DETECTOR: check}
        if spec.stack is not None:
            for stage, own in spec.stack.stages.items():
                self._latencies = {**self._latencies, stage: own.latency}

    def of(self, process: ProcessDeclaration) -> NodeSetup:
        """The setup of a process that starts for the first time."""
        return NodeSetup(
            name=process.name,
            spec=self._spec if process.sidecar else spec_for_stages(self._spec),
            kernels=self._kernels(process.name),
            latencies=dict(self._latencies),
            plug_ins=self._plug_ins,
            expected=self.names,
            clock=self._clock,
            true_path=self._true_path if process.name == SIMULATOR else None,
        )

    def _kernels(self, name: str) -> list[str]:
        """What is counted and timed in a node: of the detector its scheme, of an executable all it does."""
        if name == DETECTOR and self._spec.detector is not None:
            return [self._spec.detector.scheme]
        if self._spec.own_stage(name) is not None:
            return [name]
        own = [kernel.name for kernel in KERNELS.values() if kernel.stage == name]
        return own if self._spec.planner in KERNELS or name != PLANNING else [*own, self._spec.planner]
