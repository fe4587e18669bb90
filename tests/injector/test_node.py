"""What the injector makes of a call in which it missed what it had drawn."""

import pytest

from injector.node import LostSiteError, check_reached
from services.models.faults.specification import Site, Trigger
from services.models.outcome import InjectionRecord

pytestmark = pytest.mark.unit

EXACT = Trigger(site=Site(precision="exact", module="numba", build_id="ab", offset=523, hit=40))
ENDED = "the call ended after 1 of 40 passes"


def record(**fields: object) -> InjectionRecord:
    return InjectionRecord.model_validate(
        {"node": "perception", "kernel": "collision_check", "invocation": 3, **fields}
    )


@pytest.mark.parametrize("status", ["not_reached", "diverged"])
def test_a_call_that_ended_without_what_its_copy_executed_is_no_result(status: str) -> None:
    with pytest.raises(LostSiteError, match=ENDED):
        check_reached(record(status=status, reason=ENDED, trigger=EXACT))


@pytest.mark.parametrize(
    ("status", "trigger"),
    [("injected", EXACT), ("failed", EXACT), ("not_activated", EXACT), ("not_reached", Trigger(cpu_ns=5))],
)
def test_everything_else_is_one(status: str, trigger: Trigger) -> None:
    check_reached(record(status=status, trigger=trigger))
