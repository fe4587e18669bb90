"""Of a call whose instructions are all known, each is reached in the quickest way."""

import pytest

from injector.flight.traced_site import approach
from services.models.mission import FaultSpec, Site, Trigger
from tests.injector.calls import LOOP, caller

pytestmark = pytest.mark.usefixtures("may_inject")

PASSES = 400


def at(site: Site) -> FaultSpec:
    return FaultSpec(
        target="kernel", operand="source", register_class="gpr", trigger=Trigger(invocation=0, site=site)
    )


def in_the_loop(passing: int) -> dict[str, int]:
    """What its registers hold before the instruction's ``passing``-th execution."""
    left = PASSES - passing + 1
    return {"rcx": left, "rax": sum(range(left + 1, PASSES + 1))}


@pytest.mark.parametrize("passing", [1, 2, 77, PASSES])
def test_every_way_to_a_step_ends_at_it(passing: int) -> None:
    """By the quickest way and by steps from the first pass: told by what the loop has in ecx."""
    with caller(PASSES) as one:
        every = one.trace()
        step = [number for number, address in enumerate(every) if address == one.loop][passing - 1]
        with one.ahead() as probe:
            quickest = approach(probe.process, every, step)
        record = one.inject(at(quickest), passing)
        assert (record.status, record.instruction) == ("injected", LOOP)
        assert int(record.before, 16) == in_the_loop(passing)[record.register_name]
    with caller(PASSES) as one:
        walked = Site(precision="exact", offset=one.loop, hit=1, steps=3 * (passing - 1))
        record = one.inject(at(walked), passing)
        assert (record.status, record.instruction) == ("injected", LOOP)
        assert int(record.before, 16) == in_the_loop(passing)[record.register_name]
