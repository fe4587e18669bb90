"""Of a call whose instructions are all known, each is reached in the quickest way."""

import pytest

from injector.flight.traced_site import approach
from services.models.faults.specification import Site
from tests.injector.calls import LOOP, aimed_at_a_source, caller, registers_in_the_loop

pytestmark = pytest.mark.usefixtures("may_inject")

PASSES = 400


@pytest.mark.parametrize("passing", [1, 2, 77, PASSES])
def test_every_way_to_a_step_ends_at_it(passing: int) -> None:
    """By the quickest way and by steps from the first pass: told by what the loop has in ecx."""
    with caller(PASSES) as one:
        every = one.trace()
        step = [number for number, address in enumerate(every) if address == one.loop][passing - 1]
        with one.ahead() as probe:
            quickest = approach(probe.process, every, step)
        record = one.inject(aimed_at_a_source(quickest), passing)
        assert (record.status, record.instruction) == ("injected", LOOP)
        assert int(record.before, 16) == registers_in_the_loop(PASSES, passing)[record.register_name]
    with caller(PASSES) as one:
        walked = Site(precision="exact", offset=one.loop, hit=1, steps=3 * (passing - 1))
        record = one.inject(aimed_at_a_source(walked), passing)
        assert (record.status, record.instruction) == ("injected", LOOP)
        assert int(record.before, 16) == registers_in_the_loop(PASSES, passing)[record.register_name]
