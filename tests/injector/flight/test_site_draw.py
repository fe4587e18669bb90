"""Where a fault strikes is drawn from its seed alone, each eligible instruction alike, and reached then."""

from collections import Counter
from pathlib import Path

import pytest
from scipy.stats import chisquare

from injector.block_profile.counted_call import UncountableError
from injector.flight import site_draw
from injector.flight.site_draw import NothingEligibleError, draw_site
from services.models.faults.specification import FaultSpec, Site, Trigger, Waypoint
from services.runtime.rng import generator
from tests.injector.calls import LOOP, Caller, caller, registers_in_the_loop

pytestmark = pytest.mark.usefixtures("may_inject")

OWN_CODE = FaultSpec(target="pid", scope="kernel")
"""What is in memory without a file is pid's own code: here, the loop."""

MANY = 300_000


def drawn(one: Caller, fault: FaultSpec, seed: int) -> Site:
    trigger = draw_site(one.probes, fault, Trigger(invocation=0), generator(seed, "site"))
    assert trigger.site is not None
    assert trigger.site.precision == "exact"
    return trigger.site


def at(site: Site, fault: FaultSpec = OWN_CODE) -> FaultSpec:
    return fault.model_copy(update={"trigger": Trigger(invocation=0, site=site)})


@pytest.mark.parametrize("passes", [400, pytest.param(MANY, marks=pytest.mark.soak)])
def test_the_drawn_pass_is_struck(passes: int) -> None:
    """Told by what the loop has in its registers then; also of passes that would take long to count."""
    fault = OWN_CODE.model_copy(update={"operand": "source", "register_class": "gpr"})
    struck = 0
    for seed in range(20):
        with caller(passes) as one:
            site = drawn(one, fault, seed)
            assert site.way is None or site.way.hit + site.way.rest < site.hit
            if site.offset != one.loop:
                continue
            record = one.inject(at(site, fault), seed)
            assert (record.status, record.precision, record.instruction) == ("injected", "exact", LOOP)
            assert record.resampled == 0
            expected = registers_in_the_loop(passes, site.hit)
            assert int(record.before, 16) == expected[record.register_name]
            struck += 1
        if struck == 2:
            return
    pytest.fail("the addition was never drawn")


def test_two_processes_draw_alike() -> None:
    """Their memories lie elsewhere, so compare what does not depend on it."""
    sites = []
    for _ in range(2):
        with caller(MANY) as one:
            sites.append([(site.offset - one.loop, site.hit) for site in (drawn(one, OWN_CODE, 5),)])
    assert sites[0] == sites[1]


def test_each_instruction_of_the_call_is_as_likely_as_any_other() -> None:
    passes, draws = 5, 400
    found: Counter[tuple[int, int]] = Counter()
    with caller(passes) as one:
        for seed in range(draws):
            site = drawn(one, OWN_CODE, seed)
            found[site.offset - one.loop, site.hit] += 1
    # xor, mov, three in the loop, ret; four bytes before the loop and six after its first instruction
    alike = [(-4, 1), (-2, 1), *((place, 1 + one) for place in (0, 3, 5) for one in range(passes)), (7, 1)]
    assert set(found) == set(alike)
    assert chisquare([found[one] for one in alike]).pvalue > 0.01


def test_of_a_class_only_its_instructions_are_drawn_and_these_alike() -> None:
    """What is not eligible hands its share to nobody: of the loop only dec and jne touch flags, and add."""
    passes, draws = 4, 300
    fault = OWN_CODE.model_copy(update={"register_class": "flags", "operand": "source"})
    found: Counter[int] = Counter()
    with caller(passes) as one:
        for seed in range(draws):
            site = drawn(one, fault, seed)
            assert site.offset == one.loop + 5  # jne is the only one that reads flags
            found[site.hit] += 1
    assert chisquare([found[hit] for hit in range(1, passes + 1)]).pvalue > 0.01


def test_a_call_without_anything_eligible_is_told() -> None:
    fault = OWN_CODE.model_copy(update={"register_class": "vector"})
    with caller(3) as one, pytest.raises(NothingEligibleError, match="none of the call's 12 instructions"):
        draw_site(one.probes, fault, Trigger(), generator(0, "site"))


def test_all_that_the_thread_runs_is_drawn_from_if_asked_for() -> None:
    """Among it is what leads to the call; of the interpreter's own work this program repeats nearly all."""
    fault = FaultSpec(target="pid", scope="thread")
    with caller(50) as one:
        sites = [drawn(one, fault, seed) for seed in range(30)]
        assert len({site.module for site in sites}) > 2
        way_in = next(site for site in sites if Path(site.module).name.startswith(("_ctypes", "ld-linux")))
        record = one.inject(at(way_in, fault))
    assert record.status == "injected", record.reason
    assert record.resampled == 0


def test_a_call_that_cannot_be_counted_is_struck_by_thread_time(monkeypatch: pytest.MonkeyPatch) -> None:
    class Uncountable:
        def __init__(self, *_: object) -> None:
            raise UncountableError("no")

    monkeypatch.setattr(site_draw, "CallProfile", Uncountable)
    with caller(MANY) as one:
        trigger = draw_site(one.probes, OWN_CODE, Trigger(), generator(0, "site"))
    assert trigger.site is None
    assert trigger.cpu_ns is not None


def test_a_way_that_leads_past_the_end_is_not_reached() -> None:
    with caller(400) as one:
        way = Waypoint(offset=one.loop + 3, hit=300, rest=101)
        record = one.inject(at(Site(precision="exact", offset=one.loop, hit=401, way=way)))
        assert (record.status, record.bits) == ("not_reached", [])
        assert "400 of 401" in record.reason
        assert one.result() == one.right


def test_a_way_ends_where_the_passes_end() -> None:
    with caller(400) as one:
        way = Waypoint(offset=one.loop + 3, hit=300, rest=7)
        fault = at(Site(precision="exact", offset=one.loop, hit=307, way=way))
        record = one.inject(fault.model_copy(update={"operand": "source", "register_class": "gpr"}))
        assert int(record.before, 16) == registers_in_the_loop(400, 307)[record.register_name]
