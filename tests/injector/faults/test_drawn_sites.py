"""Sites are drawn as documented: chi-square against what exhaustive single steps count."""

from collections import Counter
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chisquare

from injector.faults.apply import apply_fault
from injector.faults.stopped_thread import stand, step
from injector.isa.instruction import Instruction
from services.models.faults.specification import FaultSpec
from services.runtime.rng import generator
from tests.injector.c_programs import Program, compiled, running_program

pytestmark = pytest.mark.usefixtures("may_inject")

KERNELS = {
    "integers": """
double kernel(void) {
    unsigned value = 27, steps = 0;
    while (value != 1 && steps < 40) { value = value & 1 ? 3 * value + 1 : value / 2; steps++; }
    return value + steps;
}
""",
    "floats": """
double kernel(void) {
    double x = 2.0, sum = 0.0;
    for (int i = 1; i < 20; i++) { x = 0.5 * (x + 2.0 / x); sum += (float)x / i; }
    return sum;
}
""",
    "memory": """
double kernel(void) {
    volatile unsigned char list[] = {5, 2, 9, 1, 7, 3};
    for (int i = 1; i < 6; i++)
        for (int j = i; j > 0 && list[j - 1] > list[j]; j--) {
            unsigned char other = list[j]; list[j] = list[j - 1]; list[j - 1] = other;
        }
    return list[0] + 10 * list[5];
}
""",
}
DRAWS = 500
SEED = 1

Site = tuple[int, str, str]


def walked(program: Program) -> list[Instruction]:
    """Every instruction from the kernel's first to its last, and some of what follows."""
    trace = []
    with program.at_kernel() as (tracees, thread, process):
        while True:
            instruction = stand(thread, process)[1]
            if not instruction.steppable:
                break
            trace.append(instruction)
            step(tracees, thread, instruction)
    program.result()
    return trace


def expected(trace: list[Instruction], length: int) -> dict[Site, Fraction]:
    """The chance of each site: an instruction's part is that of its sites, or of the next that has any."""
    chances: dict[Site, Fraction] = {}
    for start in range(length):
        found = next(one for one in trace[start:] if one.candidates)
        for candidate in found.candidates:
            site = (found.address, candidate.register, candidate.role)
            chances[site] = chances.get(site, Fraction(0)) + Fraction(1, length * len(found.candidates))
    return chances


@pytest.mark.soak
@pytest.mark.parametrize("name", KERNELS)
def test_drawn_sites_are_distributed_as_single_steps_count_them(tmp_path: Path, name: str) -> None:
    """Nothing is flipped meanwhile, and so nothing comes of it: every round is as the first."""
    with running_program(compiled(tmp_path, KERNELS[name])) as program:
        golden = program.round()
        trace = walked(program)
        length = next(at for at, one in enumerate(trace) if one.text == "ret") + 1
        assert 100 < length < 1000
        chances = expected(trace, length)
        assert sum(chances.values()) == 1
        draw = generator(SEED, "sites", DRAWS)
        drawn: Counter[Site] = Counter()
        results = Counter[str]()
        for _ in range(DRAWS):
            drawn[drawn_site(program, draw, length)] += 1
            results[program.result()] += 1
        assert results == {golden: DRAWS}
        assert set(drawn) <= set(chances)
        often = {site: float(chance) * DRAWS for site, chance in chances.items() if chance * DRAWS >= 5}
        rest = DRAWS - sum(often.values())
        assert len(often) > 10
        counts = [drawn[site] for site in often]
        assert chisquare([*counts, DRAWS - sum(counts)], [*often.values(), rest]).pvalue > 0.01


def drawn_site(program: Program, draw: np.random.Generator, length: int) -> Site:
    with program.at_kernel() as (tracees, thread, process):
        for _ in range(int(draw.integers(length))):
            assert tracees.step(thread) == "stepped"
        found = apply_fault(tracees, thread, process, FaultSpec(target="kernel", model="none"), draw)
    assert found is not None
    assert found.instruction is not None
    return found.instruction.address, found.register, str(found.operand)
