"""Campaigns whose results stand in the store as a scheduler writes them: what pages show needs no flights."""

from collections.abc import Callable
from contextlib import closing

from dashboard.campaigns.events import Begin, Flown, Leased, RunStarted
from dashboard.campaigns.spec import CampaignSpec, Run
from dashboard.campaigns.store.store import Store
from services.models.outcome import GoldenTwin, InjectionRecord, NodeReport, Outcome, QoF
from tests.dashboard.api.conftest import Serving

TWIN_S = 20.0

STRUCK = {0: ("benign", "rax", 3), 1: ("benign", "rax", 5), 2: ("sdc", "rbx", 13), 3: ("crash", "rbx", 61)}
"""What became of the node, the register and the bit that were struck, of every fourth flight of an arm."""


def ended(run: Run) -> Outcome:
    """How a run may have ended: with a fault, every fourth in a collision, and each later than its twin."""
    node_result, register, bit = STRUCK[run.index % 4]
    fault = run.spec.fault
    success = fault is None or node_result != "crash"
    delay_s = 1.0 + run.index if fault is not None else 0.0
    flown = Outcome(
        spec=run.spec,
        result="success" if success else "collision",
        qof=_flown(TWIN_S + delay_s, success=success),
        digest=f"{run.arm} {run.index}",
        wall_s=2.0,
        nodes={"control": NodeReport(result="golden")},
        topics={},
    )
    if fault is None:
        return flown
    record = InjectionRecord(
        status="injected",
        node="control",
        kernel=fault.target,
        invocation=1,
        instruction=f"mov {register}, [rsp]",
        module="libstruck.so",
        register=register,
        width_bits=64,
        bits=[bit],
    )
    twin = GoldenTwin(result="success", qof=_flown(TWIN_S, success=True), digest=f"golden {run.index}")
    nodes = {"control": NodeReport(result=node_result)}
    return flown.model_copy(update={"nodes": nodes, "injection": record, "golden": twin})


def _flown(time_s: float, *, success: bool) -> QoF:
    return QoF(
        success=success,
        flight_time_s=time_s,
        distance_m=2.5 * time_s,
        energy_kj=time_s / 2,
        state_of_charge=0.9,
        missions_per_charge=10.0,
        replans=1,
        min_clearance_m=0.5,
    )


def stored(service: Serving, spec: CampaignSpec, of: Callable[[Run], Outcome] = ended) -> str:
    """The label of a campaign that has ended."""
    with closing(Store(service.said.parent)) as store:
        found = store.create(spec)
        states = store.states(found)
        planned = store.planned(found)
        states.handle(Begin())
        states.handle(Leased("once", tuple(planned), 9.0))
        for run in planned:
            states.handle(RunStarted("once", run))
            states.handle(Flown("once", run))
        store.write(found, states, list(planned), {number: of(run) for number, run in planned.items()})
        return found.label
