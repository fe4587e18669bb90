"""Orders of one lease: what is struck in one pass stands in the first of them."""

from deploy.workers.protocol import WorkerOrder, with_faults_ahead
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec


def order(target: str = "", seed: int = 0, mission: int = 1) -> WorkerOrder:
    fault = FaultSpec(target=target, seed=seed) if target else None
    return WorkerOrder(spec=MissionSpec(seed=mission, fault=fault))


def test_the_first_fault_of_a_kernel_and_twin_brings_the_others() -> None:
    orders = [
        order(),
        order("pid", 1),
        order("octomap", 2),
        order("pid", 3),
        order("pid", 4, mission=2),
        order("octomap", 5),
        order("pid", 6),
    ]
    told = with_faults_ahead(orders)
    assert [one.spec for one in told] == [one.spec for one in orders]
    seeds = [None if one.ahead is None else [fault.seed for fault in one.ahead] for one in told]
    assert seeds == [[], [3, 6], [5], [], [], [], []]
